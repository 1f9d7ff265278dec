"""Forced responses against linear formulas, closed orbits in time, and the paper's numbers."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from threadpoolctl import threadpool_info, threadpool_limits
from truths.kinds import MEMORYLESS, silent

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes, linear_response
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl
from snrmjax.simulate.solutions import from_rest
from snrmjax.simulate.solutions.forced_response import forced_response, solve_at_frequency
from snrmjax.simulate.solutions.periodic_motion import periodic_motion

HZ = 2 * np.pi


def one_mode(potential=None, effects=(), omega=2.0, ratio=0.05, participation=1.5, sensors=1):
    shape = [[1.0]] * sensors
    modes = linear_modes([omega], [ratio], shape, [participation])
    return structure(modes, polynomial_potential(potential or {}, 1), effects=effects)


def two_modes(strength=1.0, sign=1.0, length=1.0, time=1.0):
    """Two coupled modes with two sensors; `length` and `time` count the units of a metre, s.

    With strength 0 it is linear, and uses the program compiled for the nonlinear one.
    """
    scaled = {
        key: strength * value * length ** (2 - len(key)) / time**2 * sign ** key.count("1")
        for key, value in {"1111": 0.3, "1122": 0.4, "112": 0.1}.items()
    }
    modes = linear_modes(
        np.array([2.0, 5.3]) / time,
        [0.03, 0.02],
        np.array([[1.0, 2.0], [0.5, -1.0]]) * [sign, 1.0],
        np.array([1.5, -0.5]) * [sign, 1.0],
    )
    return structure(modes, polynomial_potential(scaled, 2))


def solved(model, force, omega, guess):
    """Motions at frequencies, and whether all were found; always 16 of them to compile once."""
    n, rows = len(omega), np.minimum(np.arange(16), len(omega) - 1)
    found, converged = solve_at_frequency(
        model, jnp.full(16, force), jnp.asarray(omega)[rows], jnp.asarray(guess)[rows]
    )
    return np.asarray(found)[:n], converged[:n].tolist()


def padded(coefficients, harmonic_order):
    """The same motions with more harmonics, all zero: a guess."""
    more = np.zeros((len(coefficients), 2 * harmonic_order + 1, coefficients.shape[2]))
    more[:, : coefficients.shape[1]] = coefficients
    return jnp.asarray(more)


# ------------------------------------------------------------------------------------- exact ones


@pytest.fixture(scope="module")
def small_curves():
    """The coupled pair, linear and nonlinear, at forces that compile once for all tests here."""
    return {
        "linear": forced_response(two_modes(0.0), [0.2], 1.0, 8.0, harmonic_order=3)[0],
        "nonlinear": forced_response(two_modes(), [0.2], 1.0, 3.5, harmonic_order=3)[0],
    }


def test_a_linear_structure_gives_its_linear_response(small_curves):
    curve, model = small_curves["linear"], two_modes(0.0)
    assert curve.status == CurveStatus.UPPER_END
    assert (curve.frequency[0], curve.frequency[-1]) == (1.0, 8.0)
    wanted = linear_response(model.modes, jnp.asarray(curve.frequency), jnp.array(0.2))
    # The point is within the tolerance 1e-9 of the curve, and at its frequency by that times the
    # steepest slope, 1/ζ = 50 over the peak.
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(curve.velocity[:, 1], wanted, rtol=0, atol=5e-8 * scale)
    np.testing.assert_allclose(curve.velocity[:, [0, 2, 3]], 0.0, atol=1e-12 * scale)
    assert np.all(curve.is_stable)
    # Events: the mode of interest is in phase at its own natural frequency.
    (resonance,) = curve.at_events("phase_resonance")
    assert curve.frequency[resonance] == pytest.approx(2.0, rel=1e-12)
    assert curve.at_events("fold").size == 0
    peaks = curve.at_events("peak")
    assert len(peaks) == 2

    def slope(omega):
        f = lambda w: abs(complex(linear_response(model.modes, w, jnp.array(0.2))[0]))  # noqa: E731
        return f(omega + 1e-5) - f(omega - 1e-5)

    for k, near in zip(peaks, (2.0, 5.3), strict=True):
        exact = brentq(slope, near - 0.05, near + 0.05, xtol=1e-10)
        # The slope by differences: rounding 1e-16/(1e-5)² over a curvature of 1/(ζω)² ~ 100.
        assert curve.frequency[k] == pytest.approx(exact, abs=1e-7)


def test_signs_of_modes_and_units_do_not_matter(small_curves):
    curve = small_curves["nonlinear"]
    # The steps are the same up to rounding in the scaled unknowns; along 100 steps it grows.
    (flipped,) = forced_response(two_modes(sign=-1.0), [0.2], 1.0, 3.5, harmonic_order=3)
    np.testing.assert_allclose(flipped.frequency, curve.frequency, rtol=1e-8)
    np.testing.assert_allclose(flipped.velocity, curve.velocity, atol=1e-8)
    assert flipped.event == curve.event
    # Millimetres and milliseconds: force in kg mm/ms² = 1e3 N, velocity in mm/ms = m/s.
    model = two_modes(length=1e3, time=1e3)
    (scaled,) = forced_response(model, [0.2e-3], 1.0e-3, 3.5e-3, harmonic_order=3)
    np.testing.assert_allclose(scaled.frequency * 1e3, curve.frequency, rtol=1e-8)
    np.testing.assert_allclose(scaled.velocity, curve.velocity, atol=1e-8)


def test_every_curve_of_a_batch_is_the_curve_alone(small_curves):
    first, second = forced_response(two_modes(), [0.05, 0.2], 1.0, 3.5, harmonic_order=3)
    assert (first.force, second.force) == (0.05, 0.2)
    # Digits do not depend on the neighbours: another number of them in another order.
    others = [0.2, *np.linspace(0.02, 0.3, 18)]
    again = forced_response(two_modes(), others, 1.0, 3.5, harmonic_order=3)[0]
    np.testing.assert_array_equal(second.coefficients, again.coefficients)
    assert second.event == again.event
    alone = small_curves["nonlinear"]  # by another program: the same but for rounding
    np.testing.assert_allclose(second.frequency, alone.frequency, rtol=1e-12)
    np.testing.assert_allclose(second.velocity, alone.velocity, rtol=0, atol=1e-11)
    assert np.abs(first.velocity[:, 1, 0]).max() < np.abs(second.velocity[:, 1, 0]).max()


# -------------------------------------------------------------------------------- the two beams


@pytest.mark.parametrize(
    ("which", "start", "every"),
    [pytest.param("flat", 0, 19, marks=pytest.mark.long), ("curved", 1, 17)],
)
def test_orbits_close_in_time(which, start, every, request, time_domain, state_of):
    """Points of a curve, refined with 21 harmonics, come back to their start after a period."""
    if which == "flat":
        model, curve = request.getfixturevalue("flat_curve")
    else:  # the larger of the two forces: softening, then stiffening, second well of motions
        model, (_, curve) = request.getfixturevalue("curved_curves")
    folds = set(curve.at_events("fold"))  # at a fold the frequency does not fix the motion
    rows = [k for k in range(start, len(curve.frequency), every) if k not in folds]
    exact, converged = solved(
        model, curve.force, curve.frequency[rows], padded(curve.coefficients[rows], 21)
    )
    assert all(converged)
    assert {False, True} == set(curve.is_stable[rows].tolist())
    worst = [0.0, 0.0]
    for k, x in zip(rows, exact, strict=True):
        truth = time_domain(model, curve.force, curve.frequency[k])
        worst[0] = max(worst[0], truth.closure(state_of(curve.coefficients[k], curve.frequency[k])))
        worst[1] = max(worst[1], truth.closure(state_of(x, curve.frequency[k])))
        # The refined motion is the curve's, not another one at the same frequency.
        largest = np.abs(x).max()
        np.testing.assert_allclose(
            x[: curve.coefficients.shape[1]], curve.coefficients[k], rtol=0, atol=0.02 * largest
        )
    # Truncation: 7e-5 (flat) and 3e-3 (curved) with 9 harmonics, 4e-9 and 5e-7 with 21.
    assert worst[1] < 1e-6
    assert worst[1] < worst[0] / 100


def test_flat_beam_peaks_as_in_the_paper(flat_curve):
    # DESIGN.md item 7: peak velocity 0.762 m/s near 96.65 Hz at 1.334e-2 N.
    _, curve = flat_curve
    assert curve.force == 1.334e-2
    assert set(curve.event) == {"", "fold", "peak", "phase_resonance"}
    assert curve.sensors == ("midspan",)
    assert curve.status == CurveStatus.UPPER_END
    phase = np.exp(1j * np.outer(np.arange(10), np.linspace(0, 2 * np.pi, 1441)))
    peak = (curve.velocity[:, :, 0] @ phase).real.max(axis=1)
    top = int(np.argmax(peak))
    assert peak[top] == pytest.approx(0.762, abs=5e-4)
    assert curve.frequency[top] / HZ == pytest.approx(96.65, abs=0.05)


def test_folds_have_a_multiplier_of_one(flat_curve, curved_curves, time_domain, state_of):
    for model, curve in (flat_curve, (curved_curves[0], curved_curves[1][0])):
        folds = curve.at_events("fold")
        assert len(folds) == 2
        for k in folds:
            # Its truncation: with 21 harmonics 4e-9 of the motion (flat) and 5e-7 (curved).
            guess = padded(curve.coefficients[k : k + 1], 21)[0], curve.frequency[k]
            fold = periodic_motion(model, curve.force, guess, condition="fold")
            assert bool(fold.converged)
            assert float(fold.frequency) == pytest.approx(curve.frequency[k], rel=1e-4)
            omega = float(fold.frequency)
            multipliers = time_domain(model, curve.force, omega).multipliers(
                state_of(np.asarray(fold.coefficients), omega)
            )
            # The map's slope by differences is good to 1e-7.
            assert np.abs(multipliers - 1).min() < 1e-6
            # and the frequency has an extremum: both neighbours lie on the same side of the fold.
            sides = np.sign(curve.frequency[[k - 1, k + 1]] - curve.frequency[k])
            assert abs(sides.sum()) == 2


def test_folds_lie_where_two_motions_merge(flat_curve):
    model, curve = flat_curve
    k = curve.at_events("fold")[0]  # the upper fold
    fold = curve.frequency[k]
    below = fold * (1 - np.array([1e-5, 1e-5, 4e-5, 4e-5]))
    guesses = []
    for omega, way in zip(below, (-1, 1, -1, 1), strict=True):
        rows = np.arange(k, k + 12 * way, way)  # along one branch, away from the fold
        rows = rows[np.argsort(curve.frequency[rows])]
        flat = curve.coefficients[rows].reshape(len(rows), -1)
        guess = [np.interp(omega, curve.frequency[rows], column) for column in flat.T]
        guesses.append(np.reshape(guess, curve.coefficients[k].shape))
    x, converged = solved(model, curve.force, below, np.stack(guesses))
    assert all(converged)
    near, far = np.linalg.norm(x[0] - x[1]), np.linalg.norm(x[2] - x[3])
    assert near > 1e-3 * np.linalg.norm(x[0])
    # Their distance² falls linearly to zero at the fold: extrapolated from 1e-5 and 4e-5, with a
    # curvature of that size, it vanishes within 1e-8 of the fold's frequency.
    merge = below[0] + near**2 / (far**2 - near**2) * (below[0] - below[2])
    assert merge == pytest.approx(fold, rel=1e-7)


def test_peak_lies_where_a_dense_sweep_has_it(flat_curve):
    model, curve = flat_curve
    (k,) = curve.at_events("peak")
    shift = np.linspace(-3e-4, 3e-4, 13)
    omega = curve.frequency[k] * (1 + shift)
    guess = np.repeat(curve.coefficients[k : k + 1], len(omega), axis=0)
    found, converged = solved(model, curve.force, omega, guess)
    assert all(converged)
    fundamental = found @ np.asarray(model.modes.mode_shape)[0]
    squared = omega**2 * (fundamental[:, 1] ** 2 + fundamental[:, 2] ** 2)
    fit = np.polynomial.Polynomial.fit(shift, squared / squared.max(), 6)
    top = min((r.real for r in fit.deriv().roots() if abs(r.imag) < 1e-12), key=abs)
    # The states are good to 1e-10 of the velocity, of which the parabola over ±3e-4 takes 1e-3:
    # the top of a fit to them is good to 1e-7 of its width.
    assert top == pytest.approx(0.0, abs=1e-7)
    assert np.abs(curve.velocity[k, 1, 0]) == pytest.approx(np.sqrt(squared.max()), rel=1e-9)
    assert np.abs(curve.velocity[:, 1, 0]).max() == np.abs(curve.velocity[k, 1, 0])


def test_phase_resonances_are_in_phase(flat_curve, curved_curves):
    for curve in (flat_curve[1], *curved_curves[1]):
        (k,) = curve.at_events("phase_resonance")
        x = curve.coefficients[k, :, 0]
        assert np.angle(1j * (x[1] - 1j * x[2])) == pytest.approx(0.0, abs=1e-8)
        # A single mode: force and velocity in phase with all power lost in the viscous damping.
    for curve in curved_curves[1]:
        (k,) = curve.at_events("phase_resonance")
        model = curved_curves[0]
        orders = np.arange(1, 10)
        squared = curve.coefficients[k, 1::2, 0] ** 2 + curve.coefficients[k, 2::2, 0] ** 2
        w, zeta = float(model.modes.natural_frequency[0]), float(model.modes.damping_ratio[0])
        lost = 2 * zeta * w * curve.frequency[k] ** 2 * (orders**2 @ squared) / 2
        v1 = curve.velocity[k, 1, 0] / float(model.modes.mode_shape[0, 0])
        given = curve.force * float(model.modes.participation[0]) * v1.real / 2
        assert lost == pytest.approx(given, rel=1e-10)  # exact for any number of harmonics


# ------------------------------------------------------------------------------------- effects


@pytest.mark.parametrize("kind", MEMORYLESS)
def test_effects_agree_with_settled_motions(kind, time_domain, state_of):
    # A preload acts only together with a nonlinear stiffness; the others act alone.
    # With all, but one at strength zero: one structure, compiled once.
    effects = [
        make_effect(name, of.parameters if name == kind else silent(name, of.parameters))
        for name, of in MEMORYLESS.items()
    ]
    by_hand = partial(MEMORYLESS[kind].force, p=MEMORYLESS[kind].parameters)
    potential = {"1111": 0.1 if kind == "static_preload" else 0.0}
    model = one_mode(potential, tuple(effects))
    omega, force = 2.1, 0.35
    start = jnp.zeros((1, 19, 1)).at[0, 1, 0].set(0.1)  # far from the answer
    found, converged = solve_at_frequency(model, jnp.array([force]), jnp.array([omega]), start)
    assert bool(converged[0])
    x = np.asarray(found)[0, :, 0]
    # 25 periods of ζω = 0.1 leave e^{−7.5} of the start, and the motion decays from the balance's
    # own answer (which is wrong by 1e-3 at most): 1e-6. Corners cost no accuracy at 1e-8.
    truth = time_domain(model, force, omega, extra=by_hand)
    period = 2 * np.pi / omega
    settled = truth.integrate(state_of(x[:, None], omega), 25 * period, rtol=1e-9)[-1][0]
    times = np.linspace(0, period, 65)
    orbit = truth.integrate(settled, period, rtol=1e-9, t_eval=times)[:, 0, 0]
    tau = omega * times[:, None] * np.arange(1, 10)
    balance = x[0] + np.cos(tau) @ x[1::2] + np.sin(tau) @ x[2::2]
    # Nine harmonics of a motion with a corner in its force leave h⁻³ terms: below 2e-3.
    np.testing.assert_allclose(balance, orbit, rtol=0, atol=2e-3 * np.abs(orbit).max())
    linear = complex(linear_response(model.modes, jnp.array(omega), jnp.array(force))[0])
    change = abs(omega * 1j * (x[1] - 1j * x[2]) - linear) / abs(linear)
    assert change > 0.03 or abs(x[0]) > 0.03  # the effect is visible


# --------------------------------------------------------------------------- at given frequencies


def test_states_are_solved_each_from_its_own_guess(flat_curve):
    """Three motions at one frequency between the folds, and a state without a solution nearby."""
    model, curve = flat_curve
    omega = 94.0 * HZ
    rows = np.flatnonzero(np.diff(np.sign(curve.frequency - omega)) != 0)
    assert len(rows) == 3
    start = curve.coefficients[rows]
    found, converged = solved(model, curve.force, np.full(3, omega), start)
    assert converged == [True] * 3
    norm = np.linalg.norm(found, axis=(1, 2))
    assert np.all(np.diff(norm) < -0.05 * norm.max())  # the upper branch comes first
    start[1] = np.nan
    again, converged = solved(model, curve.force, np.full(3, omega), start)
    assert converged == [True, False, True]
    assert np.all(np.isnan(again[1]))
    np.testing.assert_array_equal(again[[0, 2]], found[[0, 2]])


def test_a_guess_of_zero_finds_the_only_motion():
    force, omega = jnp.array([0.3, 1e-4]), jnp.array([1.1, 1.9])
    found, converged = solve_at_frequency(one_mode(), force, omega, jnp.zeros((2, 3, 1)))
    assert np.all(converged)
    wanted = linear_response(one_mode().modes, omega, force)[:, 0]
    velocity = 1j * omega * (found[:, 1, 0] - 1j * found[:, 2, 0])
    np.testing.assert_allclose(velocity, wanted, rtol=1e-12)


def test_sensitivity_to_force_and_frequency_by_forward_differentiation():
    model = one_mode({"1111": 0.3})
    guess = jnp.zeros((2, 7, 1)).at[:, 1].set(0.3)

    @jax.jit
    def amplitude(force, omega):
        x, _ = solve_at_frequency(model, force, omega, guess)
        return jnp.hypot(x[:, 1, 0], x[:, 2, 0])

    force, omega = jnp.array([0.3, 0.2]), jnp.array([1.5, 2.6])
    zero, one = jnp.zeros(2), jnp.ones(2)
    _, by_force = jax.jvp(amplitude, (force, omega), (one, zero))
    _, by_frequency = jax.jvp(amplitude, (force, omega), (zero, one))
    step = 1e-4
    slope = (amplitude(force + step, omega) - amplitude(force - step, omega)) / (2 * step)
    np.testing.assert_allclose(by_force, slope, rtol=1e-6)  # h²/6·f'''/f' + 1e-12/h
    slope = (amplitude(force, omega + step) - amplitude(force, omega - step)) / (2 * step)
    np.testing.assert_allclose(by_frequency, slope, rtol=1e-6)


# -------------------------------------------------------------------------------- failing well


@pytest.mark.parametrize("force", [0.0, -1.0, np.nan, np.inf])
def test_a_force_that_is_not_positive_is_refused(force):
    with pytest.raises(ValueError, match="`forces` must be positive and finite, but is"):
        forced_response(two_modes(), [force], 1.0, 3.5, harmonic_order=3)


@pytest.mark.parametrize(
    "ends", [(3.5, 1.0), (2.0, 2.0), (0.0, 2.0), (-1.0, 2.0), (np.nan, 2.0), (1.0, np.inf)]
)
def test_an_empty_range_is_refused(ends):
    with pytest.raises(ValueError, match="`from_frequency` must be positive and below"):
        forced_response(two_modes(), [0.2], *ends, harmonic_order=3)


def with_drag(coefficient):
    """No damping but that of an effect."""
    drag = make_effect("quadratic_damping", {"coefficient": coefficient})
    return one_mode({}, (drag,), ratio=0.0)


def test_a_structure_of_nan_has_no_curve():
    broken = eqx.tree_at(lambda m: m.effects[0].coefficient, with_drag(0.1), jnp.array(jnp.nan))
    parts = forced_response(broken, [0.2], 1.0, 3.0, harmonic_order=3)
    assert [part.status for part in parts] == [CurveStatus.INVALID]
    for part in parts:
        assert len(part.frequency) == len(part.event) == len(part.stability) == 0
        assert part.velocity.shape == (0, 4, 1)
        assert part.coefficients.shape == (0, 7, 1)


def test_an_undamped_resonance_is_not_crossed():
    """Both ends trace it up to the point limit, and both parts are returned."""
    # From 1.1 on: at 1.0 the second harmonic would stand at the undamped resonance itself.
    # The tolerance holds for the scaled unknowns, which reach 1e4 here: at 1e-9 the slow flanks
    # are true to 1e-6 only.
    steps = StepControl(max_points=400, tolerance=1e-11)
    parts = forced_response(with_drag(0.0), [0.2], 1.1, 3.0, harmonic_order=3, steps=steps)
    assert [part.status for part in parts] == [CurveStatus.POINT_LIMIT] * 2
    # A step that may contain two events is subdivided by seven points.
    assert all(len(part.frequency) in (400, 407) for part in parts)
    assert set(parts[0].event + parts[1].event) == {""}  # neutral motions do not bifurcate
    assert parts[0].frequency[0] == 1.1
    assert parts[1].frequency[-1] == 3.0
    assert parts[0].frequency.max() < 2.0 < parts[1].frequency.min()
    for part in parts:  # in the order of the frequency, and exact
        assert np.all(np.diff(part.frequency) > 0)
        modes = with_drag(0.0).modes
        wanted = linear_response(modes, jnp.asarray(part.frequency), jnp.array(0.2))
        np.testing.assert_allclose(part.velocity[:, 1], wanted, rtol=1e-7)
    with pytest.raises(ValueError, match="`max_points` must be 2 or more, but is 1"):
        forced_response(
            with_drag(0.0), [0.2], 1.0, 3.0, harmonic_order=3, steps=StepControl(max_points=1)
        )


def test_damping_by_an_effect_alone_limits_a_resonance():
    (curve,) = forced_response(with_drag(0.6), [0.2], 1.0, 3.0, harmonic_order=3)
    assert curve.status == CurveStatus.UPPER_END
    assert len(curve.frequency) > 50
    (k,) = curve.at_events("phase_resonance")
    assert curve.frequency[k] == pytest.approx(2.0, rel=1e-3)
    # 8c|v|v/3π = P: one harmonic; the third changes it by 1e-3.
    wanted = np.sqrt(0.2 * 1.5 * 3 * np.pi / (8 * 0.6))
    assert np.abs(curve.velocity[k, 1, 0]) == pytest.approx(wanted, rel=2e-3)
    assert np.abs(curve.velocity[:, 1, 0]).max() == pytest.approx(wanted, rel=2e-3)


def test_curves_use_one_thread_of_blas_and_leave_its_setting(monkeypatch):
    """More wait for each other at full speed: 185 unknowns took 26 times the CPU time."""

    def threads() -> set[int]:
        return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

    seen, traced = [], from_rest.trace_from_rest
    monkeypatch.setattr(
        from_rest, "trace_from_rest", lambda *a, **k: seen.append(threads()) or traced(*a, **k)
    )
    with threadpool_limits(2, "blas"):
        forced_response(one_mode(), [1e-2], 1.5, 2.5, harmonic_order=1)
        left = threads()
    assert seen
    assert all(found == {1} for found in seen)
    assert left == {2}
