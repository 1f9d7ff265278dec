"""Responses not connected to rest, against averaging, roots of polynomials and integration."""

import numpy as np
import pytest

from snrmjax.model.builders.beams import curved_beam
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.solutions.forced_response import ResponseSettings, forced_response
from snrmjax.simulate.solutions.isolated_responses import IsolatedSearch, isolated_responses

ORDER_3 = ResponseSettings(harmonic_order=3)

HZ = 2 * np.pi
OMEGA, RATIO, UNIT = 80 * HZ, 0.01, 1e-3
ALPHA, BETA = 1.03, 0.3  # damping over the viscous one: 1 − αs + βs², s = Q/UNIT
PARTICIPATION = 3.0


def damped_oddly():
    """A linear spring whose damping falls and rises with amplitude, never negative.

    By averaging, |q̇|q̇ damps by 8cΩQ/3π and q̇³ by ¾cΩ²Q².
    """
    viscous = 2 * RATIO * OMEGA
    quadratic = -ALPHA * viscous * 3 * np.pi / (8 * OMEGA * UNIT)
    cubic = BETA * viscous / (0.75 * OMEGA**2 * UNIT**2)
    effects = (
        make_effect("quadratic_damping", {"coefficient": quadratic}),
        make_effect("cubic_damping", {"coefficient": cubic}),
    )
    modes = linear_modes([OMEGA], [RATIO], [[2.0]], [PARTICIPATION])
    return structure(modes, effects=effects), (quadratic, cubic)


# s(1 − αs + βs²) has a maximum of 0.298 and a minimum of 0.192: in between three motions meet
# the force at resonance, and the upper two belong to a loop.
FRACTION = 0.25
FORCE = FRACTION * 2 * RATIO * OMEGA * UNIT * OMEGA / PARTICIPATION


@pytest.fixture(scope="module")
def loops():
    model, _ = damped_oddly()
    ends = (70 * HZ, 90 * HZ)
    known = forced_response(model, [FORCE], *ends, harmonic_order=5, stability=False)
    return known, isolated_responses(
        model, FORCE, *ends, known=known, settings=ResponseSettings(harmonic_order=5)
    )


def test_an_isolated_loop_is_found_once_and_followed_around(loops):
    known, found = loops
    assert len(known) == 1
    assert known[0].status == CurveStatus.UPPER_END
    assert [curve.status for curve in found] == [CurveStatus.CLOSED]
    loop = found[0]
    assert loop.branch.startswith("isolated")
    np.testing.assert_array_equal(loop.coefficients[0], loop.coefficients[-1])
    assert loop.frequency[0] == loop.frequency[-1]
    # Where it crosses the linear frequency, the roots of s(1 − αs + βs²) = 0.25.
    roots = np.sort(np.roots([BETA, -ALPHA, 1.0, -FRACTION]).real)
    amplitude = np.hypot(loop.coefficients[:, 1, 0], loop.coefficients[:, 2, 0]) / UNIT
    side = np.sign(loop.frequency - OMEGA)
    crossing = np.flatnonzero(side[1:] * side[:-1] < 0)
    assert crossing.size == 2
    fraction = (OMEGA - loop.frequency[crossing]) / np.diff(loop.frequency)[crossing]
    at_resonance = amplitude[crossing] + fraction * np.diff(amplitude)[crossing]
    # Averaging leaves out the third harmonic, of the order of the damping (2 %) squared; chords
    # of the loop's 0.05 steps sag by a thousandth.
    np.testing.assert_allclose(np.sort(at_resonance), roots[1:], rtol=4e-3)
    main = np.hypot(known[0].coefficients[:, 1, 0], known[0].coefficients[:, 2, 0]) / UNIT
    assert main.max() == pytest.approx(roots[0], rel=2e-3)


def test_the_loops_stable_half_is_a_motion_in_time(loops, time_domain, state_of):
    model, (quadratic, cubic) = damped_oddly()
    loop = loops[1][0]
    k = int(np.argmax(np.abs(loop.velocity[:, 1, 0])))
    assert loop.is_stable[k]
    assert 0.2 < np.mean(loop.is_stable) < 0.8

    def extra(q, v):
        return quadratic * np.abs(v) * v + cubic * v**3

    domain = time_domain(model, FORCE, loop.frequency[k], extra)
    state = state_of(loop.coefficients[k], loop.frequency[k])
    # Seventh and higher harmonics are left out: the damping of 2 % over their order squared.
    assert domain.closure(state[None]) < 3e-5
    low = int(np.argmin(np.abs(loop.velocity[:, 1, 0])))
    assert not loop.is_stable[low]


def test_the_second_well_vibrates_with_its_own_stiffness():
    model, force = curved_beam("as_printed"), 1e-6
    curves = forced_response(model, [force], 40 * HZ, 120 * HZ, harmonic_order=3)
    (curve,) = [one for one in curves if one.branch == "from another equilibrium"]
    quadratic, cubic = (
        len(m) * float(c)
        for m, c in zip(model.potential.monomials, model.potential.coefficient, strict=True)
    )
    squared, ratio = float(model.modes.natural_frequency[0]) ** 2, 0.0
    ratio = float(model.modes.damping_ratio[0])
    roots = np.roots([cubic, quadratic, squared])
    well = roots[np.argmax(np.abs(roots))].real
    stiffness = squared + 2 * quadratic * well + 3 * cubic * well**2
    omega = curve.frequency
    load = force * float(model.modes.participation[0])
    linear = load / (stiffness - omega**2 + 2j * ratio * np.sqrt(squared) * omega)
    phasor = curve.coefficients[:, 1, 0] - 1j * curve.coefficients[:, 2, 0]
    # A force so small that the motion, 1e-4 of the well's depth, is linear to that ratio squared.
    np.testing.assert_allclose(phasor, linear, rtol=1e-4)
    np.testing.assert_allclose(curve.coefficients[:, 0, 0], well, rtol=1e-4)
    assert np.all(curve.is_stable)


def test_starts_that_are_given_are_used_and_checked():
    model = curved_beam("as_printed")
    x = np.zeros((7, 1))
    x[0] = 5e-4
    ends = (60 * HZ, 80 * HZ)
    main = forced_response(model, [1e-6], *ends, harmonic_order=3, stability=False)[:1]
    found = isolated_responses(
        *(model, 1e-6, *ends),
        known=main,
        search=IsolatedSearch(starts=[(x, 70 * HZ)], n_starts=0),
        settings=ResponseSettings(harmonic_order=3, stability=False),
    )
    assert [curve.branch for curve in found] == ["isolated, from a given start"]
    with pytest.raises(ValueError, match=r"every start must have coefficients of shape \(7, 1\)"):
        isolated_responses(
            model, 1e-6, *ends, search=IsolatedSearch([(x[:5], 70 * HZ)]), settings=ORDER_3
        )


@pytest.mark.long
def test_nothing_is_found_where_there_is_nothing():
    modes = linear_modes([OMEGA], [RATIO], [[2.0]], [PARTICIPATION])
    stiffening = structure(modes, polynomial_potential({"1111": 1e9}, 1))
    ends = (70 * HZ, 95 * HZ)
    settings = ResponseSettings(harmonic_order=3, stability=False)
    found = isolated_responses(stiffening, 0.5, *ends, settings=settings)
    assert len(found) == 0
    assert found.n_starts == 128 + 2 * 7 + 1  # random ones, at rest and linear, one resonance
    assert found.n_failed + found.n_known == found.n_starts
