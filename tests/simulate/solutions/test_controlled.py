"""Damped modes against averaging and closed forms; controlled states against the open loop."""

import numpy as np
import pytest

from snrmjax.model.builders.beams import CURVED_BEAM_FORCES, curved_beam, flat_beam
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.solutions.controlled import (
    damped_normal_mode,
    phase_controlled,
    response_controlled,
)
from snrmjax.simulate.solutions.forced_response import forced_response

HZ = 2 * np.pi
W, ZETA = 2.0, 0.03


def one_mode(potential=None, effects=(), ratio=ZETA):
    modes = linear_modes([W], [ratio], [[1.0]], [1.5])
    return structure(modes, polynomial_potential(potential or {}, 1), effects=effects)


# ------------------------------------------------------------------------------ damped modes


def test_a_linear_structure_has_its_own_damping_ratio():
    modes = linear_modes([W, 5.0], [ZETA, 0.2], [[1.0, 1.0]], [1.5, 1.0])
    branch = damped_normal_mode(structure(modes), 3.0, harmonic_order=3)
    assert branch.status == CurveStatus.AMPLITUDE_LIMIT
    np.testing.assert_allclose(branch.damping_ratio, ZETA, rtol=1e-8)
    np.testing.assert_allclose(branch.frequency, W, rtol=1e-8)
    amplitude = np.abs(branch.velocity[:, 1, 0])
    assert amplitude[0] == pytest.approx(0.03, rel=1e-6)  # a hundredth of the largest
    assert amplitude[-1] > 3.0
    assert np.all(np.diff(amplitude) > 0)


# kind: parameters and 2ζ̃ω̃ − 2ζω₀ at the displacement amplitude Q and the frequency Ω; exact in
# a single harmonic. Coulomb's force is smoothed over 0.05 of the rms velocity: 5.1e-4 less.
EXACT = 5e-8  # the tolerance 1e-9 on ξ/ω₀, which is 0.06 and more
DAMPING = {
    "quadratic_damping": ({"coefficient": 0.1}, lambda q, w: 0.8 * w * q / (3 * np.pi), 1e-5),
    "cubic_damping": ({"coefficient": 0.1}, lambda q, w: 0.075 * (w * q) ** 2, EXACT),
    "van_der_pol_damping": ({"coefficient": 0.1}, lambda q, w: 0.025 * q**2, EXACT),
    "coulomb_friction": (
        {"force": 0.02},
        lambda q, w: 0.08 * (1 - 5.1e-4) / (np.pi * w * q),
        1e-5,
    ),
}


@pytest.mark.parametrize("kind", DAMPING)
def test_damping_of_an_effect_is_its_describing_function(kind):
    _, added, tolerance = DAMPING[kind]
    # With all of them, the others at strength zero: one structure, compiled once.
    effects = tuple(
        make_effect(name, {k: v * (name == kind) for k, v in others.items()})
        for name, (others, _, _) in DAMPING.items()
    )
    branch = damped_normal_mode(one_mode({}, effects), 3.0, harmonic_order=1)
    assert branch.status == CurveStatus.AMPLITUDE_LIMIT
    assert len(branch.frequency) > 20
    q = np.hypot(branch.coefficients[:, 1, 0], branch.coefficients[:, 2, 0])
    # The extended motion obeys ω̃ = Ω (a single harmonic of q̈ + ω₀²q, no other term in phase).
    np.testing.assert_allclose(branch.frequency, W, rtol=1e-8)
    wanted = (2 * ZETA * W + added(q, W)) / (2 * W)
    np.testing.assert_allclose(branch.damping_ratio, wanted, rtol=tolerance)
    assert np.ptp(wanted) > 0.1 * ZETA


def test_a_slider_softens_and_damps_by_masings_rule():
    stiffness, slip = 0.8, 0.2
    effect = make_effect("jenkins_slider", {"stiffness": stiffness, "slip_displacement": slip})
    branch = damped_normal_mode(one_mode({}, (effect,)), 3.0, harmonic_order=1, n_samples=1024)
    q = np.hypot(branch.coefficients[:, 1, 0], branch.coefficients[:, 2, 0])
    theta = np.arccos(np.clip(1 - 2 * slip / q, -1, 1))
    change = stiffness / np.pi * (theta - np.sin(theta) * np.cos(theta)) - stiffness
    change[q <= slip] = 0
    # Sampled 1024 times: the square of the step over the slope of the loop's corners.
    np.testing.assert_allclose(branch.frequency, np.sqrt(W**2 + change), rtol=1e-4)
    lost = np.where(q > slip, 4 * stiffness * slip * (q - slip) / (np.pi * q**2), 0.0)
    wanted = (2 * ZETA * W + lost / branch.frequency) / (2 * branch.frequency)
    np.testing.assert_allclose(branch.damping_ratio, wanted, rtol=1e-3)
    assert wanted.max() > 2 * ZETA


def test_mass_proportional_damping_leaves_the_conservative_motion():
    model = curved_beam()
    branch = damped_normal_mode(model, 0.5, harmonic_order=15)
    assert branch.status == CurveStatus.AMPLITUDE_LIMIT
    # ξ = 2ζω whatever the amplitude.
    own = float(model.modes.natural_frequency[0]) * float(model.modes.damping_ratio[0])
    np.testing.assert_allclose(branch.damping_ratio * branch.frequency, own, rtol=1e-7)
    # The period of a conservative motion between its turning points, ∮ dq/√(2(E − U(q))).
    squared = float(model.modes.natural_frequency[0]) ** 2
    cubic, quartic = (float(c) for c in model.potential.coefficient)
    energy = np.polynomial.Polynomial([0, 0, 0.5 * squared, cubic, quartic])
    q = branch.coefficients[:, :, 0]
    turning = q[:, 0] + q[:, 1::2].sum(axis=1), q[:, 0] + q[:, 1::2] @ (-1.0) ** np.arange(1, 16)
    node, weight = np.polynomial.legendre.leggauss(200)
    wanted = []
    for first, second in zip(*turning, strict=True):
        roots = (energy - energy(first)).roots()
        real = roots.real[np.abs(roots.imag) < 1e-9 * abs(first)]
        other = real[np.argmin(np.abs(real - second))]
        assert second == pytest.approx(other, abs=1e-4 * abs(first))
        middle, half = 0.5 * (first + other), 0.5 * (first - other)
        at = middle + half * np.sin(0.5 * np.pi * node)
        # U(q₀) − U(q) over (q₀ − q)(q − q₁), whose singularity the substitution removes.
        rest = (energy(first) - energy) // np.polynomial.Polynomial.fromroots([first, other])
        wanted.append(2 * np.pi / (np.pi * weight @ (1 / np.sqrt(-2 * rest(at)))))
    assert np.min(wanted) < 0.8 * np.sqrt(squared)
    # With fifteen harmonics 1e-6 of the motion is truncated at the largest amplitude.
    np.testing.assert_allclose(branch.frequency, wanted, rtol=1e-5)


# --------------------------------------------------------------------- controlled steady states


def test_phase_control_goes_through_the_phase_resonances_of_the_open_loop():
    model = curved_beam()
    largest = CURVED_BEAM_FORCES[-1]
    curve = phase_controlled(model, largest, harmonic_order=9)
    assert curve.status == CurveStatus.UPPER_END
    assert curve.force[-1] == pytest.approx(largest, rel=1e-12)
    assert curve.force[0] == pytest.approx(0.01 * largest, rel=1e-9)
    phase = np.angle(curve.velocity[:, 1, 0])
    np.testing.assert_allclose(phase, 0.0, atol=1e-7)
    responses = forced_response(model, CURVED_BEAM_FORCES, 20 * HZ, 150 * HZ, stability=False)
    responses = [one for one in responses if one.status == CurveStatus.UPPER_END]
    for response in responses:
        (k,) = response.at_events("phase_resonance")
        # Where the force is the response's, by the cubic through four neighbours.
        m = int(np.clip(np.searchsorted(curve.force, response.force), 2, len(curve.force) - 2))
        rows = slice(m - 2, m + 2)
        for ours, theirs in (
            (curve.frequency, response.frequency[k]),
            (np.abs(curve.velocity[:, 1, 0]), np.abs(response.velocity[k, 1, 0])),
        ):
            fit = np.polynomial.Polynomial.fit(curve.force[rows], ours[rows], 3)
            assert fit(response.force) == pytest.approx(theirs, rel=1e-4)
    # At its end no interpolation is needed.
    (k,) = responses[-1].at_events("phase_resonance")
    assert curve.frequency[-1] == pytest.approx(responses[-1].frequency[k], rel=1e-7)


def test_the_phase_resonances_of_a_linear_mode():
    curve = phase_controlled(one_mode(), 0.3, harmonic_order=1)
    assert curve.status == CurveStatus.UPPER_END
    np.testing.assert_allclose(np.angle(curve.velocity[:, 1, 0]), 0.0, atol=1e-7)
    np.testing.assert_allclose(curve.frequency, W, rtol=1e-8)
    np.testing.assert_allclose(
        np.abs(curve.velocity[:, 1, 0]), curve.force * 1.5 / (2 * ZETA * W), rtol=1e-8
    )


def test_response_control_goes_through_states_of_the_open_loop(numpy_balance):
    model, velocity = flat_beam(), 0.5
    curve = response_controlled(model, velocity, 75 * HZ, 105 * HZ, harmonic_order=9)
    assert curve.status == CurveStatus.UPPER_END
    assert (curve.frequency[0], curve.frequency[-1]) == pytest.approx((75 * HZ, 105 * HZ))
    np.testing.assert_allclose(np.abs(curve.velocity[:, 1, 0]), velocity, rtol=1e-8)
    assert np.all(np.diff(curve.frequency) > 0)  # no fold under control
    for k in range(0, len(curve.frequency), 7):  # each a solution under its own force
        scale = np.abs(curve.coefficients[k]).max()
        balance = numpy_balance(model, curve.force[k], 9, scale)
        point = np.append(curve.coefficients[k].ravel() / scale, curve.frequency[k] / balance.unit)
        exact = balance.solved(point, len(point) - 1)
        np.testing.assert_allclose(point, exact, rtol=0, atol=1e-7)
    # The least force is at the phase resonance: |F| = |V₁| over the mobility.
    least = int(np.argmin(np.abs(curve.force)))
    (response,) = forced_response(
        model, [float(curve.force[least])], 60 * HZ, 110 * HZ, stability=False
    )
    (peak,) = response.at_events("peak")
    assert np.abs(response.velocity[peak, 1, 0]) == pytest.approx(velocity, rel=2e-3)


def test_response_control_of_a_linear_mode():
    curve = response_controlled(one_mode(), 0.4, 1.0, 3.0, harmonic_order=1)
    omega = curve.frequency
    wanted = 0.4 * np.abs(W**2 - omega**2 + 2j * ZETA * W * omega) / (1.5 * omega)
    np.testing.assert_allclose(curve.force, wanted, rtol=1e-7)


def test_wrong_arguments_are_refused():
    model = one_mode()
    with pytest.raises(ValueError, match="`largest_velocity` must be positive and finite"):
        damped_normal_mode(model, 0.0)
    with pytest.raises(ValueError, match="`largest_force` must be positive and finite"):
        phase_controlled(model, np.nan)
    with pytest.raises(ValueError, match="`velocity` must be positive and finite"):
        response_controlled(model, -1.0, 1.0, 2.0)
    with pytest.raises(ValueError, match="`from_frequency` must be positive and below"):
        response_controlled(model, 1.0, 2.0, 1.0)
    modes = linear_modes([2.0, 3.0], [0.1, 0.1], [[0.0, 1.0]], [1.0, 1.0])
    with pytest.raises(ValueError, match="first sensor does not see the mode of interest"):
        response_controlled(structure(modes), 1.0, 1.0, 2.0)
