"""Folds, peaks, resonances and bifurcations against an independent balance and period maps."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from snrmjax.model.builders.beams import (
    CURVED_BEAM_FORCES,
    FLAT_BEAM_FORCES,
    curved_beam,
    flat_beam,
)
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.continuation import bifurcations, events
from snrmjax.simulate.continuation.bifurcations import with_bifurcations
from snrmjax.simulate.continuation.continuation import (
    CurveEvent,
    CurveStatus,
    StepControl,
    TracedCurve,
)
from snrmjax.simulate.continuation.curve_tracing import response_balances
from snrmjax.simulate.continuation.events import EVENT_KINDS
from snrmjax.simulate.solutions.forced_response import forced_response

HZ = 2 * np.pi
# How often each event occurs along the curved beam's three responses from 20 to 150 Hz.
CURVED = {"fold": (2, 4, 4), "peak": (1, 3, 2), "phase_resonance": (1, 1, 1)}


def in_steps(step):
    return StepControl(first=step, largest=step)


def counts(curve):
    return {kind: curve.at_events(kind).size for kind in EVENT_KINDS}


def extrema(values):
    """Maxima and minima along a sequence of values."""
    rising = np.sign(np.diff(values))
    return int(np.sum(rising[1:] < rising[:-1])), int(np.sum(rising[1:] > rising[:-1]))


@pytest.fixture(scope="module")
def curved_in_steps():
    """The curved beam's responses at the paper's forces, by the largest step."""
    model = curved_beam()
    return model, {
        step: [
            curve
            for curve in forced_response(
                *(model, CURVED_BEAM_FORCES, 20 * HZ, 150 * HZ),
                steps=in_steps(step),
                stability=False,
            )
            # The others start from rest and fold back at a superharmonic resonance.
            if curve.status == CurveStatus.UPPER_END
        ]
        for step in (0.003, 0.02, 0.05, 0.15, 0.3)
    }


def test_no_event_is_lost_in_steps_of_any_size(curved_in_steps):
    _, curves = curved_in_steps
    for step, responses in curves.items():
        assert len(responses) == 3
        for number, curve in enumerate(responses):
            wanted = {kind: CURVED[kind][number] for kind in EVENT_KINDS}
            assert counts(curve) == wanted, (step, number)
            for kind in EVENT_KINDS:  # and they are the same events
                fine = curves[0.003][number]
                found, exact = (c.frequency[c.at_events(kind)] for c in (curve, fine))
                # Located to 1e-12 in the scaled unknowns, a peak by its tangent to 1e-6.
                np.testing.assert_allclose(found, exact, rtol=1e-6, err_msg=f"{step}, {kind}")
    # Counts of reference: in fine steps every extremum of frequency and velocity is resolved.
    for number, curve in enumerate(curves[0.003]):
        assert len(curve.frequency) > 1000
        assert sum(extrema(curve.frequency)) == CURVED["fold"][number]
        assert extrema(np.abs(curve.velocity[:, 1, 0]))[0] == CURVED["peak"][number]
        x = curve.coefficients[:, :, 0]
        in_phase = np.sign(x[1:, 1]) != np.sign(x[:-1, 1])
        assert np.sum(in_phase & (x[1:, 2] > 0)) == CURVED["phase_resonance"][number]


def assert_located(curve, model, numpy_balance):
    """Every event of a curve agrees with the independent balance."""
    order = (curve.coefficients.shape[1] - 1) // 2
    balance = numpy_balance(model, curve.force, order, np.abs(curve.coefficients).max())
    seen = 0
    for kind in EVENT_KINDS:
        for k in curve.at_events(kind):
            omega, velocity = balance.event(kind, curve.coefficients[k], curve.frequency[k])
            assert curve.frequency[k] == pytest.approx(omega, rel=1e-6), kind
            # At a fold the velocity changes with the root of the frequency.
            tolerance = 1e-5 if kind == "fold" else 1e-6
            assert np.abs(curve.velocity[k, 1, 0]) == pytest.approx(velocity, rel=tolerance), kind
            seen += 1
    return seen


@pytest.mark.parametrize("step", [0.05, 0.3])
def test_events_of_the_curved_beam_are_located(step, curved_in_steps, numpy_balance):
    model, curves = curved_in_steps
    seen = [assert_located(curve, model, numpy_balance) for curve in curves[step]]
    assert seen == [4, 8, 7]


def test_events_of_the_flat_beam_are_located(flat_curve, numpy_balance):
    model, curve = flat_curve
    assert counts(curve) == {"fold": 2, "peak": 1, "phase_resonance": 1}
    assert assert_located(curve, model, numpy_balance) == 4
    assert sum(extrema(curve.frequency)) == 2


# --------------------------------------------------------------------------------- near a cusp

SQUARED, VISCOUS, HARDENING = 4.0, 0.08, 0.9  # ω², 2ζω and ¾·4c of the mode below


def duffing():
    """q̈ + 0.08 q̇ + 4 q + 1.2 q³ = P cos Ωt."""
    modes = linear_modes([2.0], [0.02], [[1.0]], [1.0])
    return structure(modes, polynomial_potential({"1111": 0.3}, 1))


def parts(amplitude, load):
    """m and r of Ω² = m ± √r, a single harmonic: ((ω² + ¾·4c Q² − Ω²)² + (2ζωΩ)²) Q² = P²."""
    stiffness = SQUARED + HARDENING * amplitude**2
    middle = stiffness - 0.5 * VISCOUS**2
    return middle, middle**2 - stiffness**2 + (load / amplitude) ** 2


def exact_folds(load):
    """Frequencies of the folds: extrema of the upper root, dm/dQ + (dr/dQ)/(2√r) = 0, times √r."""

    def slope(amplitude):
        by_root = -HARDENING * amplitude * VISCOUS**2 - load**2 / amplitude**3
        return 2 * HARDENING * amplitude * np.sqrt(parts(amplitude, load)[1]) + by_root

    def outermost(amplitude):
        return parts(amplitude, load)[1]

    largest = brentq(outermost, 0.1 * load / VISCOUS, load / VISCOUS)  # both roots meet there
    amplitude = np.linspace(0.2 * largest, largest * (1 - 1e-9), 4001)
    values = slope(amplitude)
    where = np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))
    ends = [brentq(slope, amplitude[k], amplitude[k + 1], xtol=1e-15) for k in where]
    exact = [parts(q, load) for q in ends]
    return np.array([np.sqrt(middle + np.sqrt(root)) for middle, root in exact])


@pytest.fixture(scope="module")
def cusp():
    """The load at which the two folds of the Duffing oscillator are born."""
    low, high = 0.05, 0.2
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if len(exact_folds(middle)) else (middle, high)
    return high


@pytest.mark.parametrize("above", [0.1, 1e-2, 1e-3, -1e-3])
@pytest.mark.parametrize("step", [0.05, 0.3])
def test_two_close_folds_inside_one_step_are_found(above, step, cusp):
    load = cusp * (1 + above)
    wanted = np.sort(exact_folds(load))
    assert len(wanted) == (2 if above > 0 else 0)
    for begin in (1.0, 1.1, 1.2, 1.3):  # different positions of the steps
        (curve,) = forced_response(
            *(duffing(), [load], begin, 4.0),
            harmonic_order=1,
            steps=in_steps(step),
            stability=False,
        )
        folds = curve.at_events("fold")
        np.testing.assert_allclose(np.sort(curve.frequency[folds]), wanted, rtol=1e-9)
        if 0 < above < 0.1:  # indeed between two points of the traced curve
            assert np.ptp(wanted) < 1e-3
            assert abs(folds[1] - folds[0]) <= 8


# ------------------------------------------------------------------------------- bifurcations


def coupled_by_a_square():
    """A second mode at twice the first one's frequency: they exchange energy."""
    modes = linear_modes([2.0, 4.0], [0.01, 0.01], [[1.0, 0.0]], [1.0, 0.0])
    return structure(modes, polynomial_potential({"112": 0.5}, 2))


def symmetric():
    """The oscillator of `duffing` with the curved beam's names: they share compiled programs."""
    beam = curved_beam()
    numbers = (
        *(beam.modes.natural_frequency, beam.modes.damping_ratio, beam.modes.mode_shape),
        *(beam.modes.participation, beam.potential.coefficient),
    )
    values = [2.0], [0.02], [[1.0]], [1.0], [0.0, 0.3]
    return eqx.tree_at(
        lambda m: (
            *(m.modes.natural_frequency, m.modes.damping_ratio, m.modes.mode_shape),
            *(m.modes.participation, m.potential.coefficient),
        ),
        beam,
        tuple(jnp.asarray(v).reshape(n.shape) for v, n in zip(values, numbers, strict=True)),
    )


# model, force, range, harmonics, and how often
CROSSINGS = {
    "period_doubling": (curved_beam, CURVED_BEAM_FORCES[1], (20 * HZ, 80 * HZ), 31, 5),
    "neimark_sacker": (coupled_by_a_square, 0.4, (1.7, 2.3), 5, 2),
    "branch_point": (symmetric, 15.0, (0.9, 3.0), 31, 2),
}


def crossing(kind, multipliers):
    """A function of the multipliers that changes sign at a bifurcation of this kind."""
    if kind == "neimark_sacker":
        return np.abs(multipliers[np.abs(multipliers.imag) > 1e-3]).max() - 1
    return np.prod(multipliers + (1 if kind == "period_doubling" else -1)).real


@pytest.mark.parametrize("kind", CROSSINGS)
def test_bifurcations_lie_where_multipliers_cross(kind, numpy_balance, time_domain, state_of):
    model, force, ends, order, number = CROSSINGS[kind]
    model = model()
    (curve, *_) = forced_response(model, [force], *ends, harmonic_order=order)
    where = curve.at_events(kind)
    assert len(where) == number
    assert not any(curve.at_events(other).size for other in CROSSINGS if other != kind)
    balance = numpy_balance(model, force, order, np.abs(curve.coefficients).max())
    for k in where:
        start = np.append(curve.coefficients[k].ravel(), curve.frequency[k])
        start /= np.append(np.full(len(start) - 1, balance.scale), balance.unit)
        along = balance.tangent(start, np.ones(len(start)))
        fixed = int(np.argmax(np.abs(along)))
        values, frequencies = [], []
        for shift in (0.0, 1e-5):  # along the unknown that changes fastest
            y = balance.solved(start + along * (shift / along[fixed]), fixed)
            omega = y[-1] * balance.unit
            x = y[:-1].reshape(-1, balance.n) * balance.scale
            multipliers = time_domain(model, force, omega).multipliers(state_of(x, omega))
            values.append(crossing(kind, multipliers))
            frequencies.append(omega)
        fraction = values[0] / (values[0] - values[1])
        # The multiplier is 1e-6 beyond the circle; the map's slope by differences is good to
        # 1e-7; the motions by their truncation to 5e-7 at the lowest, to 1e-10 elsewhere.
        error = fraction * (frequencies[1] - frequencies[0]) / curve.frequency[k]
        assert abs(error) < 1e-6, (kind, k)
        assert abs(fraction) < 1  # and it is this crossing, not another one far away
    # The stability changes only there and at folds.
    change = np.flatnonzero(curve.stability[1:] != curve.stability[:-1])
    labelled = np.concatenate([where, curve.at_events("fold")])
    assert all(np.min(np.abs(labelled - k)) <= 1 for k in change)


def test_folds_of_the_flat_beam_do_not_depend_on_the_steps():
    found = []
    for step in (0.003, 0.05, 0.3):
        (curve,) = forced_response(
            *(flat_beam(), [FLAT_BEAM_FORCES[-1]], 60 * HZ, 120 * HZ),
            steps=in_steps(step),
            stability=False,
        )
        assert counts(curve) == {"fold": 2, "peak": 1, "phase_resonance": 1}
        found.append(np.concatenate([curve.frequency[curve.at_events(k)] for k in EVENT_KINDS]))
    # Located to 1e-12 in the scaled unknowns, the peak by its tangent to 1e-6.
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=1e-6)
    assert sum(extrema(curve.frequency)) == 2


def test_flat_beam_folds_at_all_forces_are_as_many_as_its_turns():
    model = flat_beam()
    curves = forced_response(model, FLAT_BEAM_FORCES, 60 * HZ, 120 * HZ, stability=False)
    assert [counts(curve)["fold"] for curve in curves] == [0, 0, 2, 2]
    for curve in curves:
        assert counts(curve)["peak"] == counts(curve)["phase_resonance"] == 1


# ------------------------------------------------------------- rows of multipliers, failed searches


def line_with_a_crossing(monkeypatch, between):
    """A curve of six points whose one multiplier has left the circle at the fourth.

    `between` are the points that are found between neighbours, from the exact ones.
    """
    model = structure(linear_modes([1.0], [0.1], [[1.0]], [1.0]))
    balance = response_balances([model], np.array([1.0]), 1, None)
    points = np.outer(np.arange(6.0), [0, 0, 0, 1.0])

    def multipliers_at(_, __, frequency):
        crossed = 0.5 + 1.0 * (frequency >= 3.0)
        return (-crossed - 1e-3 * frequency)[:, None].astype(complex)

    def points_between(_, __, neighbours, fraction, ___):
        here = neighbours[0][:, -1] + fraction
        found, ok = between(here)
        along = np.outer(np.ones(len(here)), [0, 0, 0, 1.0])
        return np.outer(found, [0, 0, 0, 1.0]), along, ok

    def many_multipliers(_, __, points):
        return multipliers_at(None, None, points[:, -1])

    monkeypatch.setattr(bifurcations, "many_multipliers", many_multipliers)
    monkeypatch.setattr(bifurcations, "points_between", points_between)
    curve = TracedCurve(points, np.outer(np.ones(6), [0, 0, 0, 1.0]), events=(CurveEvent.NONE,) * 6)
    curve = curve._replace(multipliers=multipliers_at(None, None, points[:, -1]))
    return with_bifurcations(balance, [curve], StepControl())[0], multipliers_at


def test_multipliers_stay_with_their_points_where_two_points_are_one(monkeypatch):
    # The crossing is at the fourth point itself: both are the same numbers.
    found, multipliers_at = line_with_a_crossing(
        monkeypatch, lambda exact: (exact, np.ones(len(exact), dtype=bool))
    )
    assert found.points[:, -1].tolist() == [0, 1, 2, 3, 3, 4, 5]
    assert found.events.index("period_doubling") in (3, 4)
    wanted = multipliers_at(None, None, found.points[:, -1])
    np.testing.assert_array_equal(found.multipliers, wanted)


def test_a_bifurcation_that_is_not_located_is_named(monkeypatch):
    found, _ = line_with_a_crossing(
        monkeypatch, lambda exact: (exact, np.zeros(len(exact), dtype=bool))
    )
    assert found.not_located == ("bifurcation",)
    assert len(found.points) == 6


@pytest.mark.parametrize(
    ("position", "height", "number"),
    [
        (2.0 + 1e-8, 1.00001, 0),  # within the accuracy of the location
        (2.4, 1.05, 0),  # a jump near the fold: no pair is on the circle
        (2.4, 1.0, 1),  # a pair crosses the circle near the fold
    ],
)
def test_a_fold_with_a_crossing_at_the_same_point_is_one_event(
    position, height, number, monkeypatch
):
    # A Neimark-Sacker point has a pair on the circle, a fold a real multiplier at +1.
    model = structure(linear_modes([1.0, 2.0], [0.1, 0.1], [[1.0, 1.0]], [1.0, 1.0]))
    balance = response_balances([model], np.array([1.0]), 1, None)
    along = np.eye(7)[-1]

    def multipliers_of(_, __, points):
        behind = points[:, -1] - position
        modulus = np.where(behind > 0, height, min(height, 2 - height)) + 0.01 * behind
        turn = np.exp(0.7j)
        fold = 1.0 + 0.01 * (points[:, -1] - 2.0)
        return np.stack([modulus * turn, modulus / turn, fold, 0.1 * fold], axis=1)

    def points_between(_, __, neighbours, fraction, ___):
        found = np.outer(neighbours[0][:, -1] + fraction, along)
        return found, np.outer(np.ones(len(found)), along), np.ones(len(found), dtype=bool)

    monkeypatch.setattr(bifurcations, "many_multipliers", multipliers_of)
    monkeypatch.setattr(bifurcations, "points_between", points_between)
    points = np.outer(np.arange(6.0), along)
    kinds = [CurveEvent.FOLD if k == 2 else CurveEvent.NONE for k in range(6)]
    curve = TracedCurve(points, np.outer(np.ones(6), along), events=tuple(kinds))
    curve = curve._replace(multipliers=multipliers_of(None, None, points))
    found = with_bifurcations(balance, [curve], StepControl())[0]
    assert found.not_located == ()
    assert [e for e in found.events if e] == ["fold", *["neimark_sacker"] * number]


def test_a_fold_that_is_not_located_is_named():
    # No error is small enough: Newton's method converges nowhere, and no sign change is resolved.
    model = curved_beam()
    (curve,) = forced_response(model, CURVED_BEAM_FORCES[:1], 20 * HZ, 150 * HZ, stability=False)
    assert curve.not_located == ()
    balances = response_balances([model], np.array([curve.force]), 9, None)
    x = curve.coefficients.reshape(len(curve.frequency), -1)
    scales = float(balances.displacement_scale[0]), float(balances.frequency_scale[0])
    points = np.concatenate([x / scales[0], curve.frequency[:, None] / scales[1]], axis=1)
    steps = np.diff(points, axis=0)
    tangents = np.concatenate([steps, steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    bare = TracedCurve(points, tangents, events=(CurveEvent.NONE,) * len(points))
    (found,) = events.with_events(balances, [bare], StepControl(tolerance=-1.0))
    assert len(found.points) == len(points)
    assert {"fold", "peak", "phase_resonance"} == set(found.not_located)
