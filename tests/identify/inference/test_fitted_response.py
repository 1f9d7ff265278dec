"""Responses of a joint fit against closed forms, bands against finite differences."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from truths import joint_fits
from truths.exact_states import CONSTANT, TRUE, damping, exact, modes, noisy, squared
from truths.joint_fits import noisy_fit

import snrmjax as sj
from snrmjax.identify.inference.fitted_curves import as_backbone
from snrmjax.identify.inference.forced_motion import InitialPoint, solved_point
from snrmjax.identify.prediction.new_level import WITHOUT_LEVEL_ERRORS
from snrmjax.io.joint_results import write_next

FORCE = 2.2  # N: folds are there


@pytest.fixture(scope="module")
def fit():
    """A fit of noisy states: stiffness of the displacement, damping of the velocity."""
    return noisy_fit()


@pytest.fixture(scope="module")
def exact_fit():
    """A fit of exact states: its curves are the known ones."""
    return joint_fits.exact_fit()


def moved(fit, vector):
    """The fit with other unknowns."""
    return eqx.tree_at(lambda f: f.unknowns, fit, fit.vector()[1](jnp.asarray(vector)))


def test_resonance_of_known_curves(exact_fit):
    found = sj.identify.fitted_response(exact_fit, FORCE)[0].resonances[0]
    low, high = 1e-5, 1e-2
    for _ in range(200):  # X with X ω̃ δ(X ω̃) = A F, by bisection
        middle = 0.5 * (low + high)
        speed = middle * np.sqrt(squared(middle))
        low, high = (middle, high) if speed * damping(speed) < CONSTANT * FORCE else (low, middle)
    assert found.frequency == pytest.approx(np.sqrt(squared(low)), rel=1e-8)
    assert found.velocity == pytest.approx(low * np.sqrt(squared(low)), rel=1e-8)
    assert not found.continued


@pytest.mark.long
def test_a_larger_ratio_extends_the_range(exact_fit):
    largest = exact_fit.largest[0]
    x = 2.5 * largest
    speed = x * np.sqrt(squared(x))
    force = speed * damping(speed) / CONSTANT
    (near,) = sj.identify.fitted_response(exact_fit, force)
    (far,) = sj.identify.fitted_response(exact_fit, force, largest_amplitude_ratio=3.0)
    assert near.resonances == ()
    assert far.resonances[0].frequency == pytest.approx(speed / x, rel=1e-6)
    assert far.resonances[0].continued
    # The largest amplitude lies slightly beyond phase resonance.
    assert far.notes[0]["ratio"] == pytest.approx(2.5, rel=1e-3)


@pytest.mark.long
def test_a_curve_that_falls_beyond_the_data_keeps_the_inner_resonance(exact_fit):
    # ω̃² = a(1 − 0.4 u): X ω̃ has its largest value at u = 1.25, short of 1.5² times the data.
    vector = np.array(exact_fit.vector()[0])
    vector[1] = -0.4 * vector[0]
    falling = moved(exact_fit, vector)
    x = 0.5 * float(falling.unknowns.squared_frequency.scale)
    speed = x * np.sqrt(vector[0] * (1 - 0.4 * 0.25))
    force = speed * float(falling.unknowns.modal_damping(speed)) / CONSTANT
    # Beyond that maximum the velocity falls, and there is a second resonance.
    resonances = sj.identify.fitted_response(falling, force)[0].resonances
    (found,) = (point for point in resonances if not point.continued)
    assert found.frequency == pytest.approx(speed / x, rel=1e-9)
    assert found.velocity == pytest.approx(speed, rel=1e-9)


def test_every_point_satisfies_the_known_curves(exact_fit):
    curve = sj.identify.fitted_response(exact_fit, FORCE)[0]
    speed = np.abs(curve.velocity)
    x = speed / curve.frequency
    needed = squared(x) - curve.frequency**2 + 1j * curve.frequency * damping(speed)
    # Newton converges to rounding, which a steep flank of the curve amplifies.
    np.testing.assert_allclose(np.abs(needed) * x / CONSTANT, FORCE, rtol=1e-8)
    np.testing.assert_allclose(np.angle(needed) + np.angle(curve.velocity), np.pi / 2, atol=1e-8)


def test_folds_are_where_the_frequency_reverses(exact_fit):
    found = sj.identify.fitted_response(exact_fit, FORCE)[0].folds
    assert len(found) == 2
    # Ω against X at fixed force, scanned: |(ω̃² − Ω²) + iΩδ| X = A F by bisection above ω̃.
    x = np.linspace(4e-4, 2.2e-3, 4001)

    def needed(omega):
        return np.abs(squared(x) - omega**2 + 1j * omega * damping(x * omega)) * x

    upper = np.sqrt(squared(x))
    there = needed(upper) < CONSTANT * FORCE
    low, high = upper.copy(), 3 * upper
    for _ in range(100):
        middle = 0.5 * (low + high)
        below = needed(middle) < CONSTANT * FORCE
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    omega = np.where(there, low, np.nan)
    fold_frequencies = [np.nanmin(omega[: int(np.nanargmax(omega))]), np.nanmax(omega)]
    np.testing.assert_allclose(
        sorted(p.frequency for p in found), sorted(fold_frequencies), rtol=1e-6
    )


@pytest.mark.long
@pytest.mark.parametrize("kind", ["resonance", "fold"])
def test_slopes_of_points_are_central_differences(fit, kind):
    curve = sj.identify.fitted_response(fit, FORCE, of=WITHOUT_LEVEL_ERRORS)[0]
    best = max(curve.resonances if kind == "resonance" else curve.folds, key=lambda p: p.velocity)
    start = InitialPoint(kind, best.velocity / best.frequency, best.frequency)
    slopes = solved_point(fit, FORCE, start).slopes[:2]
    vector = np.asarray(fit.vector()[0])
    for k in range(4):  # the curves' own parameters
        step = 1e-5 * max(abs(vector[k]), 1.0)
        values = []
        for sign in (1, -1):
            there = moved(fit, vector + sign * step * np.eye(len(vector))[k])
            one = sj.identify.fitted_response(there, FORCE, of=WITHOUT_LEVEL_ERRORS)[0]
            points = one.resonances if kind == "resonance" else one.folds
            near = max(points, key=lambda p: p.velocity)
            values.append([near.frequency, near.velocity])
        difference = (np.array(values[0]) - np.array(values[1])) / (2 * step)
        # Errors of the differences: step², and the points' 1e-9 over the step.
        np.testing.assert_allclose(slopes[:, k], difference, rtol=1e-4, atol=1e-7)
    std = np.sqrt(np.einsum("op,pq,oq->o", slopes, fit.covariance, slopes))
    np.testing.assert_allclose([best.frequency_std, best.velocity_std], std, rtol=1e-9)


@pytest.mark.long
def test_band_of_a_curve_is_the_spread_of_sampled_curves(fit):
    rng = np.random.default_rng(0)
    vector = np.asarray(fit.vector()[0])
    root = np.linalg.cholesky(fit.covariance + 1e-14 * np.eye(len(vector)))
    speeds = np.array([0.3, 0.6, 0.85])
    samples = [
        np.asarray(
            sj.identify.fitted_values(
                moved(fit, vector + root @ rng.normal(size=len(vector))), speeds
            ).modal_damping
        )
        for _ in range(150)
    ]
    values = sj.identify.fitted_values(fit, speeds)
    # 150 draws determine a standard deviation to 1/sqrt(300).
    np.testing.assert_allclose(np.std(samples, axis=0), values.modal_damping_std, rtol=3 * 0.058)


def test_a_new_level_has_a_wider_band(fit):
    prior = dataclasses.replace(fit.prior, new_level=np.array([0.01, 0.0, 0.004, 0.05]))
    problem = dataclasses.replace(fit.problem, prior=prior)
    scattering = dataclasses.replace(fit, problem=problem)
    speeds = np.array([0.3, 0.8])
    plain = sj.identify.fitted_values(scattering, speeds)
    wide = sj.identify.fitted_values(scattering, speeds, include_level_variance=True)
    extra = np.sqrt(wide.modal_damping_std**2 - plain.modal_damping_std**2)
    np.testing.assert_allclose(extra, 0.05 * np.asarray(plain.modal_damping), rtol=1e-9)


def test_the_backbone_for_other_tools_is_the_same_curve(fit):
    backbone = as_backbone(fit)
    amplitude = np.linspace(2e-4, 1.9e-3, 9)
    speed = np.asarray(backbone.velocity(amplitude))
    values = sj.identify.fitted_values(fit, speed)
    # 120 knots of a shape-preserving cubic.
    np.testing.assert_allclose(
        backbone.natural_frequency(amplitude), values.natural_frequency, rtol=1e-5
    )
    np.testing.assert_allclose(backbone.modal_damping(amplitude), values.modal_damping, rtol=1e-4)


def test_advice_narrows_the_band_and_avoids_what_cannot_be_measured(fit):
    advice = sj.next_measurements(fit, 4)
    ratios = [one.expected_band_ratio for one in advice]
    assert all(np.diff(ratios) < 0)
    assert 0 < ratios[-1] < ratios[0] < 1
    for one in advice:
        curve = sj.identify.fitted_response(fit, one.force)[0]
        near = np.argmin(np.abs(curve.velocity - one.velocity * np.exp(1j * one.phase)))
        assert curve.stable[near]
        assert not curve.continued[near]
        assert all(abs(one.frequency / f.frequency - 1) > 0.002 for f in curve.folds)
        assert one.reason["fraction"] > 0


@pytest.mark.long
def test_advice_achieves_the_expected_band_ratio():
    """The measured ratio of bands after adding the advised state is the expected one.

    Level errors are stated: estimated ones would be better known with one more level, and the band
    narrower still.
    """
    known = {"level_gain_std": 0.01, "level_phase_std": 0.003, "level_damping_std": 6e-5}
    structure = sj.model.structure(modes(), level_frequency_std=0.5, **known)
    data = noisy(3, gain=0.01)
    fit = sj.fit_jointly(data, structure, **TRUE)
    level = np.asarray(fit.data.level)
    one = sj.next_measurements(fit, 1, target="damping")[0]
    velocity = one.velocity * np.exp(1j * one.phase)
    more = sj.measure.steady_states(
        [level.max() + 1],
        [one.frequency],
        [one.force],
        [velocity],
        velocity_std=np.array([0.01 * one.velocity]),
        phase_std=np.array([0.012]),
        force_std=np.array([0.003 * one.force]),
    )
    again = sj.fit_jointly(sj.measure.join_steady_states(data, more), structure, **TRUE)
    speeds = np.abs(np.asarray(fit.motion().velocity))
    at = np.linspace(speeds.min(), speeds.max(), 25)
    bands = [
        np.mean(np.asarray(v.modal_damping_std / v.modal_damping))
        for v in (sj.identify.fitted_values(f, at) for f in (again, fit))
    ]
    # The new state lies on the fit's curve: only the bands change.
    assert bands[0] / bands[1] == pytest.approx(one.expected_band_ratio, abs=0.005)


def test_no_measurable_state_is_reported(fit):
    none = sj.next_measurements(fit, 2, from_frequency=5000.0)
    assert len(none) == 0
    assert none.status.kind == "no_state_to_measure"
    assert "no stable state" in repr(none)
    few = sj.next_measurements(fit, 10_000, forces=[1.0])
    assert 0 < len(few) < 10_000
    assert few.status.kind == "fewer_candidates"


@pytest.mark.long
def test_where_only_the_drive_is_known_advice_is_in_volts(tmp_path):
    level, omega, force, velocity = exact()
    gain = 0.4  # N/V
    data = sj.measure.steady_states(
        *(level, omega, np.full(len(level), np.nan), velocity),
        velocity_std=0.01 * np.abs(velocity),
        phase_std=np.full((len(level), 1), 0.01),
        drive=force / gain,
    )
    fit = sj.fit_jointly(data, modes(), **TRUE)
    advice = sj.next_measurements(fit, 2, forces=[2.0, 4.0])  # V
    assert {round(one.drive, 9) for one in advice} <= {2.0, 4.0}
    for one in advice:
        assert one.force == pytest.approx(gain * one.drive, rel=1e-6)
    assert " V, " in repr(advice)
    assert advice.to_xarray()["drive_v"].attrs["units"] == "V"
    assert "force_n" not in advice.to_pandas()
    write_next(tmp_path / "next.csv", advice)
    header, first, _ = (tmp_path / "next.csv").read_text().splitlines()
    assert header == "rank,force_n,frequency_hz,expected_band_ratio,reason,drive_v"
    assert float(first.split(",")[1]) == pytest.approx(advice[0].force)
    assert float(first.split(",")[-1]) == pytest.approx(advice[0].drive)


@pytest.mark.long
def test_advice_is_a_table(fit):
    advice = sj.next_measurements(fit, 3)
    table = advice.to_pandas()
    assert list(table["rank"]) == [1, 2, 3]
    assert table["frequency_hz"][0] == pytest.approx(advice[0].frequency / (2 * np.pi))
    assert advice.to_xarray()["force_n"].attrs["units"] == "N"
    assert repr(advice).startswith("NextMeasurements: 3 states")
    assert advice.plot().axes
    assert advice.notes == ()
    ended = dataclasses.replace(fit, converged=False)
    assert "has not converged" in repr(sj.next_measurements(ended, 1))
