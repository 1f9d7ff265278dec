"""Summaries, labels and plots of the results of an identification."""

import dataclasses

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

import snrmjax as sj

N = 12
MODES = sj.model.linear_modes([500.0], [0.01], [[2.0]], [3.0], sensors=("tip",))


@pytest.fixture(scope="module")
def identification():
    """Two levels of a linear mode, with a state that was not measured and a note of the reader."""
    frequency = np.tile(np.linspace(495.0, 505.0, N // 2), 2)
    force = np.repeat([1.0, 2.0], N // 2)
    velocity = sj.identify.snrm_velocity(
        MODES, 500.0 + 0 * force, 0.01 + 0 * force, frequency, force
    )
    velocity = np.asarray(velocity).copy()
    velocity[2] = np.nan
    data = sj.measure.steady_states(
        np.repeat([1, 2], N // 2), frequency, force, velocity, sensors=("tip",)
    )
    return sj.identify_backbone(dataclasses.replace(data, notes=("read so",)), MODES)


def test_the_identification(identification):
    assert repr(identification).startswith("Identification: 12 steady states of 2 levels at 'tip'")
    assert "11 ok" in repr(identification)
    assert identification.notes[0] == "read so"
    data = identification.to_xarray()
    assert data.natural_frequency_hz.attrs["units"] == "Hz"
    np.testing.assert_allclose(data.natural_frequency_hz.max(), 500.0 / (2 * np.pi), rtol=1e-9)
    assert data.status.values[2] == "not_finite"
    assert isinstance(identification.plot(), Figure)


def test_the_points(identification):
    assert repr(identification.points).startswith("BackbonePoints: 12 states")
    table = identification.points.to_pandas()
    assert len(table) == N
    assert {"level", "frequency_hz", "force_n", "damping_ratio_std", "status"} <= set(table.columns)
    assert isinstance(identification.points.plot(), Figure)


def test_the_curves(identification):
    backbone = identification.backbone
    values = backbone.values(np.linspace(0.5, 1.0, 7) * float(backbone.largest))
    for result in (backbone, values):
        assert "natural frequency 79.577" in repr(result)
        assert result.to_xarray().natural_frequency_hz.attrs["units"] == "Hz"
        assert isinstance(result.plot(), Figure)
    assert len(values.to_pandas()) == 7


def test_predictions(identification):
    backbone = identification.backbone
    (tip,) = sj.identify.resonances(backbone, MODES, 1.5)
    assert "frequency 79.57" in repr(tip)
    assert tip.to_xarray().velocity_m_s.attrs["units"] == "m/s"
    (curve,) = sj.identify.predict_response(backbone, MODES, 1.5)
    assert repr(curve).startswith("PredictedResponse: 400 points")
    assert curve.to_xarray().frequency_hz.attrs["units"] == "Hz"
    assert isinstance(curve.plot(), Figure)


def test_inversions():
    points = sj.identify.invert_phasor(
        np.full(3, 6.0), np.full(3, 500.0), np.array([0.6 + 0j, np.nan, 0.5 + 0.1j]), np.zeros(3)
    )
    assert repr(points).startswith("SnrmPoints: 3 members")
    table = points.to_pandas()
    assert table.natural_frequency_hz[0] == pytest.approx(500.0 / (2 * np.pi))
    assert "shape=(3,)" in repr(jax.eval_shape(lambda: points))
