"""Every result of a simulation prints on one screen, is labelled and can be plotted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import snrmjax as sj
from snrmjax.io.results import write_response
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.solutions import forced_response, from_rest

FORCE, ENDS = 0.12, (1.0, 4.0)


def oscillator():
    potential = sj.model.polynomial_potential({"111": 0.05, "1111": 0.3}, 1)
    modes = sj.model.linear_modes([2.0], [0.02], [[1.0]], [1.5], sensors=("tip",))
    return sj.model.structure(modes, potential)


@pytest.fixture(scope="module")
def curve():
    (found,) = sj.forced_response(oscillator(), FORCE, *ENDS, harmonic_order=3)
    return found


# Near a peak at `FORCE`: coefficients and rad/s.
PEAK = (np.array([0.0, 0.0, 1.0, 0.0, 0.0])[:, None], 2.22)
SETTINGS = sj.simulate.ResponseSettings(harmonic_order=3, stability=False)
# How a result is computed, its first printed line, and a variable with its unit.
RESULTS = {
    "forced response": (
        lambda: sj.forced_response(oscillator(), [FORCE], *ENDS, harmonic_order=3)[0],
        ("forced response at 0.12 N: ", "stability", "1"),
    ),
    "isolated responses": (
        lambda: sj.simulate.isolated_responses(
            oscillator(), FORCE, *ENDS, known=[], settings=SETTINGS
        ),
        ("IsolatedResponses: 1 curve", "velocity_m_s", "m/s"),
    ),
    "event curve": (
        lambda: sj.simulate.follow_event(
            *(oscillator(), FORCE, PEAK),
            kind="peak",
            to=(0.5 * FORCE, FORCE),
        ),
        ("peak over force: ", "parameter", "N"),
    ),
    "batch": (
        lambda: sj.simulate.forced_response_batch(
            oscillator(), [0.1, 0.12], *ENDS, settings=SETTINGS, keep_curves=False
        ),
        ("ResponseBatch: 2 members", "peak_frequency_hz", "Hz"),
    ),
    "normal mode": (
        lambda: sj.nonlinear_normal_mode(oscillator(), 3.0, harmonic_order=3),
        ("NormalModeBranch: ", "energy_j", "J"),
    ),
    "damped mode": (
        lambda: sj.simulate.damped_normal_mode(oscillator(), 2.0, harmonic_order=3),
        ("DampedModeBranch: ", "natural_frequency_hz", "Hz"),
    ),
    "phase control": (
        lambda: sj.simulate.phase_controlled(oscillator(), FORCE, harmonic_order=3),
        ("ControlledCurve: ", "force_n", "N"),
    ),
    "virtual test": (
        lambda: sj.phase_resonance_test(
            *(oscillator(), np.array([0.05, FORCE]), *ENDS),
            harmonic_order=3,
        ),
        ("VirtualTest: 10 states", "force_n", "N"),
    ),
}


@pytest.mark.parametrize("name", RESULTS)
def test_results_are_printed_and_drawn(name):
    compute, (first, variable, unit) = RESULTS[name]
    result = compute()
    lines = repr(result).splitlines()
    assert lines[0].startswith(first)
    assert 3 <= len(lines) <= 14
    assert max(map(len, lines)) < 160
    data = result.to_xarray()
    assert data[variable].attrs["units"] == unit
    for each in data.variables.values():
        assert each.attrs["long_name"]
        assert not np.iscomplexobj(each.values)  # files cannot hold them
    assert isinstance(result.plot(), Figure)


def test_motions_report_what_did_not_converge(curve):
    heights = jnp.array([0.2, 30.0]) * np.abs(curve.velocity[:, 1, 0]).max()

    def motion_at(height):
        return sj.simulate.periodic_motion(
            oscillator(), FORCE, curve.point(40), condition="velocity", value=height
        )

    found = jax.vmap(motion_at)(heights)
    assert repr(found).startswith("PeriodicMotion: 2 motions")
    data = found.to_xarray()
    assert data["converged"].values.tolist() == [True, False]
    assert isinstance(found.plot(), Figure)
    one = sj.simulate.periodic_motion(oscillator(), FORCE, curve.point(40), value=1.5)
    assert one.to_xarray()["frequency_hz"].values == pytest.approx(1.5 / HERTZ)
    assert isinstance(one.plot(), Figure)


def test_tables_have_one_row_per_member():
    batch, (first, _, _) = RESULTS["batch"][0](), RESULTS["batch"][1]
    assert repr(batch).startswith(first)
    table = batch.to_pandas()
    assert table["member"].tolist() == [0, 1]
    np.testing.assert_allclose(table["peak_frequency_hz"] * HERTZ, batch.peak_frequency)
    assert set(table["status"]) == {"upper_end"}
    assert set(table["n_not_located"]) == {0}


def test_a_response_is_labelled_as_its_file_is(curve):
    data = curve.to_xarray()
    np.testing.assert_allclose(data["frequency_hz"], curve.frequency / HERTZ)
    fundamental = data["velocity_h1_re_m_s"] + 1j * data["velocity_h1_im_m_s"]
    np.testing.assert_array_equal(fundamental.sel(sensor="tip"), curve.velocity[:, 1, 0])
    # Of two peaks of nearly one height the one with the higher of 96 samples is taken: by them
    # heights are known to (3π/96)²/2.
    angle = np.outer(np.arange(1, 4), np.linspace(0, 2 * np.pi, 4097))
    samples = (curve.velocity[:, 1:, 0] @ np.exp(1j * angle)).real
    peak = data["velocity_peak_m_s"].sel(sensor="tip")
    np.testing.assert_allclose(peak, np.abs(samples).max(axis=1), rtol=5e-3)
    assert set(data["event"].values) == {"", "fold", "peak", "phase_resonance"}


def test_stability_that_was_not_computed_is_neither_stable_nor_unstable(curve):
    kind = sj.simulate.Stability
    assert {kind(k) for k in curve.stability} == {kind.STABLE, kind.UNSTABLE}
    np.testing.assert_array_equal(curve.is_stable, ~curve.is_unstable)
    (bare,) = sj.forced_response(oscillator(), FORCE, *ENDS, harmonic_order=3, stability=False)
    assert set(bare.stability) == {kind.NOT_COMPUTED}
    assert not np.any(bare.is_stable | bare.is_unstable)
    styles = {line.get_linestyle() for line in bare.plot().axes[0].lines}
    assert "--" not in styles  # no part is drawn as unstable
    # One point whose multipliers could not be computed, on a curve that has the others.
    multipliers = curve.multipliers.copy()
    multipliers[3] = np.nan
    holed = dataclasses.replace(curve, multipliers=multipliers)
    assert holed.stability[3] == kind.NOT_COMPUTED
    assert np.sum(holed.stability == kind.NOT_COMPUTED) == 1


def test_files_state_where_stability_was_not_computed(curve, tmp_path):
    multipliers = curve.multipliers.copy()
    multipliers[3] = np.nan
    fold = int(curve.at_events("fold")[0])
    multipliers[fold] = np.nan
    holed = dataclasses.replace(curve, multipliers=multipliers)
    write_response(tmp_path / "response.csv", [holed])
    rows = [line.split(",") for line in (tmp_path / "response.csv").read_text().splitlines()]
    stable, event = rows[0].index("stable"), rows[0].index("event")
    body = rows[1:]
    assert {row[stable] for row in body} == {"0", "1"}  # what readers may rely on
    assert (body[3][stable], body[3][event]) == ("0", "stability_not_computed")
    assert body[fold][event] == "fold+stability_not_computed"
    assert sum("stability_not_computed" in row[event] for row in body) == 2


def test_one_many_and_arrays_of_forces_are_the_same():
    ways = (FORCE, [FORCE], (FORCE,), np.array([FORCE]), np.float64(FORCE))
    settings = {"harmonic_order": 1, "stability": False}
    found = [sj.forced_response(oscillator(), way, *ENDS, **settings) for way in ways]
    for curves in found:
        assert len(curves) == 1
        np.testing.assert_array_equal(curves[0].frequency, found[0][0].frequency)
    with pytest.raises(ValueError, match=r"`forces` must be positive and finite, but is -1"):
        sj.forced_response(oscillator(), np.array([FORCE, -1.0]), *ENDS)


def test_a_second_branch_that_stops_early_is_the_status_of_its_member(curve):
    kind = sj.simulate.CurveStatus
    assert curve.status == kind.UPPER_END
    stopped = dataclasses.replace(curve, status=kind.POINT_LIMIT)
    for parts, status in (
        ((curve,), kind.UPPER_END),
        ((curve, stopped), kind.POINT_LIMIT),
        ((stopped, curve), kind.POINT_LIMIT),
    ):
        assert forced_response._summary(parts)["status"] == status


def test_a_branch_that_has_no_start_is_named(monkeypatch):
    # Stiffening carries the resonance beyond the upper end, where the low branch comes in.
    ends, settings = (1.0, 2.15), {"harmonic_order": 3, "stability": False}
    assert len(sj.forced_response(oscillator(), FORCE, *ends, **settings)) == 2
    plain = from_rest.trace_from_rest

    def upward_only(*arguments, downward, **named):
        traced = plain(*arguments, downward=downward, **named)
        empty = {"points": np.zeros((0, 8)), "status": sj.simulate.CurveStatus.NO_START}
        return [one._replace(**empty) for one in traced] if downward else traced

    monkeypatch.setattr(from_rest, "trace_from_rest", upward_only)
    (curve,) = sj.forced_response(oscillator(), FORCE, *ends, **settings)
    assert curve.not_located == ("branch",)
