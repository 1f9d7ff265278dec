"""Continued motions: against a fold's closed form, and in an optimisation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, least_squares

from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.solutions.forced_response import forced_response
from snrmjax.simulate.solutions.periodic_motion import periodic_motion
from snrmjax.simulate.solutions.tracked_motion import TrackedMotion

OMEGA, RATIO, CUBIC, LOAD, FORCE = 400.0, 0.01, 1e10, 1.5, 3.0


def oscillator(cubic=CUBIC):
    model = structure(
        linear_modes([OMEGA], [RATIO], [[1.0]], [LOAD]), polynomial_potential({"1111": 1.0}, 1)
    )
    return eqx.tree_at(lambda m: m.potential.coefficient, model, jnp.asarray([cubic / 4.0]))


def upper_fold(cubic):
    """Frequency of the upper fold of q̈ + 2ζω q̇ + ω² q + γ q³ = P cos Ωt with one harmonic.

    With A = Q² and u = ω² + ¾γA − Ω² the balance is A (u² + (2ζω)²Ω²) = P²; where its derivative by
    A vanishes as well, u = −P²/(1.5 γ A²). Of the roots in A the largest is the upper fold.
    """

    def left(square):
        u = -((LOAD * FORCE) ** 2) / (1.5 * cubic * square**2)
        fast = OMEGA**2 + 0.75 * cubic * square - u
        return square * (u**2 + (2 * RATIO * OMEGA) ** 2 * fast) - (LOAD * FORCE) ** 2, fast

    peak = (LOAD * FORCE / (2 * RATIO * OMEGA**2)) ** 2
    grid = np.geomspace(1e-6, 1.0, 2000) * peak
    (changes,) = np.nonzero(np.diff(np.signbit([left(square)[0] for square in grid])))
    ends = grid[changes[-1]], grid[changes[-1] + 1]
    return np.sqrt(left(brentq(lambda square: left(square)[0], *ends, xtol=1e-300))[1])


@pytest.fixture(scope="module")
def fold():
    (curve,) = forced_response(
        oscillator(), FORCE, 0.8 * OMEGA, 2.0 * OMEGA, harmonic_order=1, stability=False
    )
    start = curve.point(max(curve.at_events("fold"), key=lambda k: curve.frequency[k]))
    return TrackedMotion(oscillator(), FORCE, start, condition="fold"), start


@pytest.fixture(scope="module")
def found(fold):
    """Frequencies of the fold and their slopes by the cubic coefficients, of four at once."""
    tracked, _ = fold

    def at(cubic):
        return tracked.at(oscillator(cubic)).frequency

    return jax.jit(jax.vmap(jax.value_and_grad(at)))


def test_a_fold_is_continued_to_where_a_fixed_start_finds_another(fold, found):
    _, start = fold
    cubics = CUBIC * np.array([0.6, 6.0, 30.0, 100.0])
    frequency, slope = found(cubics)
    for k, cubic in enumerate(cubics):
        assert float(frequency[k]) == pytest.approx(upper_fold(cubic), rel=1e-10)
        sides = [upper_fold(cubic * (1 + shift)) for shift in (-1e-3, 1e-3)]
        chord = (sides[1] - sides[0]) / (2e-3 * cubic)
        assert float(slope[k]) == pytest.approx(chord, rel=1e-5)
    fixed = periodic_motion(oscillator(cubics[3]), FORCE, start, condition="fold")
    assert not abs(float(fixed.frequency) / float(frequency[3]) - 1) < 0.1  # the lower fold, or NaN


def test_an_optimisation_arrives_at_the_fold_that_is_asked_for(found):
    wanted = upper_fold(12.0 * CUBIC)

    def miss(logarithm):
        return np.asarray(found(np.repeat(CUBIC * np.exp(logarithm), 4))[0])[:1] / wanted - 1

    def slope(logarithm):
        cubic = CUBIC * np.exp(logarithm)
        return np.asarray(found(np.repeat(cubic, 4))[1])[:1, None] * cubic / wanted

    arrived = least_squares(miss, [0.0], jac=slope, gtol=1e-12)
    assert arrived.success
    assert np.exp(arrived.x[0]) == pytest.approx(12.0, rel=1e-8)


def test_where_the_motion_ends_on_the_way_all_is_nan(found):
    # Almost linear: both folds have met in a cusp before.
    value, slope = found(np.full(4, 1e-3 * CUBIC))
    assert np.all(np.isnan(value))
    assert np.all(np.isnan(slope))


def test_what_cannot_be_continued_is_refused(fold):
    tracked, (coefficients, frequency) = fold
    with pytest.raises(ValueError, match="`model` has other monomials than"):
        tracked.at(structure(oscillator().modes, polynomial_potential({"111": 1.0}, 1)))
    with pytest.raises(ValueError, match='`condition="fold"` takes no `value`'):
        tracked.at(value=500.0)
    with pytest.raises(ValueError, match="was found near `start`: take a point"):
        TrackedMotion(oscillator(), FORCE, (100 * coefficients, 3 * frequency), condition="fold")
