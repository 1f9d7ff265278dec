"""What figures read off results, from results small enough to read off by eye."""

from types import SimpleNamespace

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.identify.pointwise.prediction import PredictedResponse
from snrmjax.numerics.units import HERTZ
from snrmjax.report import sampling as plot_data

# Five points up and down a peak of 8 m/s; the second sensor moves half as far.
SHAPE = np.array([1.0, 4.0, 8.0, 4.0, 1.0])
FREQUENCY = np.array([10.0, 20.0, 30.0, 40.0, 50.0])


@pytest.fixture
def predicted():
    at = np.zeros(5, dtype=bool)
    return PredictedResponse(2.0, FREQUENCY, 1j * SHAPE, SHAPE, ~at, ("lead",) * 5, at, False, ())


@pytest.fixture
def simulated():
    # Harmonics 0 to 2 of two sensors: only the fundamental counts.
    velocity = np.full((5, 3, 2), 100.0 + 0j)
    velocity[:, 1] = SHAPE[:, None] * [1.0, -0.5j]
    return sj.simulate.ResponseCurve(
        force=2.0,
        frequency=FREQUENCY,
        coefficients=np.zeros((5, 5, 1)),
        velocity=velocity,
        multipliers=np.full((5, 2), 0.5 + 0j),
        event=("",) * 5,
        status=sj.simulate.CurveStatus.UPPER_END,
        sensors=("tip", "root"),
    )


def test_velocity_is_the_fundamental_at_the_sensor(predicted, simulated):
    np.testing.assert_array_equal(plot_data.velocity_of(simulated, "root"), -0.5j * SHAPE)
    np.testing.assert_array_equal(plot_data.velocity_of(predicted, "any"), 1j * SHAPE)
    with pytest.raises(ValueError, match=r"one of tip, root, but is 'middle'"):
        plot_data.velocity_of(simulated, "middle")


def test_span_is_where_a_quarter_of_the_peak_is_exceeded(predicted, simulated):
    # 4 of 8 m/s is, 1 of 8 is not: from 20 to 40 rad/s, and a tenth of 20 rad/s on both sides.
    for curve in (predicted, simulated):
        np.testing.assert_allclose(plot_data.span_of(curve, "root"), (18.0, 42.0), rtol=1e-15)


def test_phase_at_resonance_is_zero_for_both_signs_of_the_modal_constant():
    turned = np.exp(0.25j * np.pi)
    for constant in (3.0, -3.0):
        backbone = SimpleNamespace(modal_constant=constant)
        phase = plot_data.phase_of([constant, constant * turned], backbone)
        np.testing.assert_allclose(phase, [0.0, 45.0], atol=1e-13)  # rounding of 45°


def test_damping_of_the_points_that_curves_use():
    points = SimpleNamespace(
        usable=[True, False, True],
        backbone_velocity=[1.0, 2.0, 3.0],
        natural_frequency=[2.0, 2.0, 2.0],
        modal_damping=[4.0, 5.0, 6.0],
    )
    velocity, damping = plot_data.usable_damping(points)
    assert (velocity.tolist(), damping.tolist()) == ([1.0, 3.0], [4.0, 6.0])


def test_measured_states_under_about_a_force():
    data = sj.measure.steady_states(
        np.array([1, 1, 2, 2]),
        HERTZ * np.array([10.0, 11.0, 12.0, 13.0]),
        np.array([2.0, 2.05, 2.2, 2.0]),
        np.array([[1.0, 5.0], [2.0, 6.0], [3.0, 7.0], [4.0, 8.0]]) + 0j,
        sensors=("tip", "root"),
        measured=np.array([[True, True]] * 3 + [[False, True]]),
    )
    frequency, velocity = plot_data.measured_near(data, "tip", 2.0, 0.03)
    np.testing.assert_allclose(frequency, [10.0, 11.0], rtol=1e-15)
    np.testing.assert_array_equal(velocity, [1.0, 2.0])
    assert plot_data.measured_near(data, "root", 2.0, 0.03)[1].tolist() == [5.0, 6.0, 8.0]
    nothing = plot_data.measured_near(None, "tip", 2.0, 0.03)
    assert [len(part) for part in nothing] == [0, 0]
    with pytest.raises(ValueError, match="but is 'middle'"):
        plot_data.measured_near(data, "middle", 2.0, 0.03)
