"""Floquet multipliers against exact ones, Mathieu's equation and integrated period maps."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import mathieu_a, mathieu_b

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structure import structure
from snrmjax.simulate.stability import floquet_multipliers, is_stable, steps_per_period


def one_mode(omega, ratio=0.0, potential=None, effects=()):
    modes = linear_modes([omega], [ratio], [[1.0]], [1.0])
    return structure(modes, polynomial_potential(potential or {}, 1), effects=effects)


def cosine(amplitude, order=1):
    """Coefficients of q = A cos τ, one point for every amplitude."""
    x = np.zeros((len(amplitude), 2 * order + 1, 1))
    x[:, 1, 0] = amplitude
    return jnp.asarray(x)


def test_linear_modes_have_their_decay_as_multipliers(distance_between):
    w, zeta = np.array([2.0, 5.0]), np.array([0.03, 0.2])
    model = structure(linear_modes(w, zeta, [[1.0, 1.0]], [1.0, 1.0]))
    frequency = np.array([1.7, 3.0])
    root = -zeta * w + 1j * w * np.sqrt(1 - zeta**2)
    errors = []
    for n_steps in (128, 256):
        found = floquet_multipliers(
            model, jnp.zeros((2, 3, 2)), jnp.asarray(frequency), n_steps=n_steps
        )
        exact = np.exp(np.concatenate([root, root.conj()]) * (2 * np.pi / frequency)[:, None])
        errors.append(max(distance_between(a, b) for a, b in zip(found, exact, strict=True)))
        assert np.all(is_stable(found))
    # Fourth order: a step of h = 2π·5/(1.7·128) has (ωh)⁵/120 · 128 ≈ 7e-5, half the step 1/16.
    assert errors[0] < 7e-5
    assert errors[1] == pytest.approx(errors[0] / 16, rel=0.2)


def test_undamped_growth_and_decay_are_told_apart():
    frequency, at_rest = jnp.array([2.0]), jnp.zeros((1, 3, 1))
    for slope, stable in ((0.01, True), (-0.01, False)):
        # f = slope·q̇ as the linear part of a van der Pol effect is none: use the motion itself.
        effect = make_effect("van_der_pol_damping", {"coefficient": slope})
        model = one_mode(2.0, effects=(effect,))
        found = floquet_multipliers(model, cosine([1.0]), frequency, n_steps=128)
        assert bool(is_stable(found)[0]) is stable
    saddle = floquet_multipliers(
        one_mode(1.0, potential={"11": -1.0}), at_rest, frequency, n_steps=128
    )
    # q̈ = q: multipliers e^{±T}, T = π.
    np.testing.assert_allclose(sorted(np.abs(saddle[0])), np.exp([-np.pi, np.pi]), rtol=1e-6)
    assert not is_stable(saddle)[0]


def test_mathieu_equation_changes_stability_at_its_characteristic_values():
    # q = A cos τ in ω²q + q³·4c gives δ'' + (ω² + 6cA²(1 + cos 2τ))/Ω² δ = 0: Mathieu's equation
    # y'' + (a − 2p cos 2τ) y = 0 with a = (ω² + 6cA²)/Ω², p = −3cA²/Ω².
    frequency, quartic = 1.3, 0.25
    parameter = np.array([0.1, 0.4, 0.9])
    amplitude = frequency * np.sqrt(parameter / (3 * quartic))
    for order in (1, 2):
        # Even in p up to an exchange of a and b for odd orders.
        for characteristic in (mathieu_a(order, parameter), mathieu_b(order, parameter)):
            for k, value in enumerate(characteristic):
                squared = (value - 2 * parameter[k]) * frequency**2
                if squared <= 0:
                    continue
                model = one_mode(np.sqrt(squared), potential={"1111": quartic})
                found = floquet_multipliers(
                    model, cosine(amplitude[k : k + 1]), jnp.array([frequency]), n_steps=512
                )[0]
                # A solution of period π or 2π: both multipliers are 1, and their trace is 2 with
                # the square of their common error (a double eigenvalue splits by a square root).
                assert complex(found.sum()) == pytest.approx(2.0, abs=1e-6)
                assert complex(found.prod()) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("shift", "stable"), [(-0.05, True), (0.5, False), (1.05, True)], ids=["below", "in", "above"]
)
def test_mathieu_tongue_of_first_order_is_unstable_inside(shift, stable):
    frequency, quartic, parameter = 1.3, 0.25, 0.2
    low, high = sorted([mathieu_a(1, parameter), mathieu_b(1, parameter)])
    squared = (low + shift * (high - low) - 2 * parameter) * frequency**2
    # A damping of 1e-4 makes neutral motions decay without closing the tongue.
    model = one_mode(np.sqrt(squared), ratio=1e-4, potential={"1111": quartic})
    amplitude = frequency * np.sqrt(parameter / (3 * quartic))
    found = floquet_multipliers(model, cosine([amplitude]), jnp.array([frequency]), n_steps=256)
    assert bool(is_stable(found)[0]) is stable


def test_product_of_multipliers_is_the_mean_damping():
    # Liouville: det = exp(−∮ 2ζω + ∂f/∂q̇ dt), whatever the stiffness does.
    w, zeta, frequency, amplitude = 2.0, 0.05, 1.7, 0.8
    cases = {
        "van_der_pol_damping": lambda c: c * amplitude**2 / 2,
        "cubic_damping": lambda c: 3 * c * (frequency * amplitude) ** 2 / 2,
        "quadratic_damping": lambda c: 2 * c * frequency * amplitude * 2 / np.pi,
    }
    for kind, mean in cases.items():
        # All three are there, two of them with strength zero: one shape, which compiles once.
        effects = [make_effect(k, {"coefficient": 0.3 if k == kind else 0.0}) for k in cases]
        model = one_mode(w, zeta, {"1111": 0.2}, tuple(effects))
        found = floquet_multipliers(model, cosine([amplitude]), jnp.array([frequency]), n_steps=256)
        wanted = np.exp(-(2 * zeta * w + mean(0.3)) * 2 * np.pi / frequency)
        # Fourth order in 2π/256, and second order at the kinks of |q̇|: (2π/256)²/6.
        tolerance = 1e-4 if kind == "quadratic_damping" else 1e-6
        assert complex(found[0].prod()) == pytest.approx(wanted, rel=tolerance), kind


def test_steps_resolve_the_fastest_mode():
    model = structure(linear_modes([1.0, 40.0], [0.0, 0.0], [[1.0, 1.0]], [1.0, 1.0]))
    assert steps_per_period(model, 1.0) == 32 * 40
    assert steps_per_period(model, 0.9) == 32 * 45
    assert steps_per_period(one_mode(1.0), 1.0) == 128


@pytest.mark.parametrize("which", ["flat", "curved"])
def test_multipliers_along_a_response_are_those_of_the_integrated_map(
    which, request, time_domain, state_of, distance_between
):
    if which == "flat":
        model, curve = request.getfixturevalue("flat_curve")
    else:
        model, (curve, _) = request.getfixturevalue("curved_curves")
    n_steps = steps_per_period(model, float(curve.frequency.min()))
    padded = -len(curve.frequency) % 128
    rows = np.append(np.arange(len(curve.frequency)), np.full(padded, -1))
    found = floquet_multipliers(
        model, jnp.asarray(curve.coefficients[rows]), jnp.asarray(curve.frequency[rows]), n_steps
    )
    # 32 steps a cycle of the fastest mode: phase error (2π/32)⁴/120 a radian, over the 33 cycles
    # in a period of 60 Hz 2.5e-3. Closed motions are known to 1e-4 with nine harmonics.
    tolerance = 3e-3 if which == "flat" else 2e-5
    kinds = [np.flatnonzero(curve.stable), np.flatnonzero(~curve.stable)]
    assert all(len(kind) >= 16 for kind in kinds)
    for k in np.concatenate([kind[:: len(kind) // 7] for kind in kinds]):
        truth = time_domain(model, curve.force, curve.frequency[k]).multipliers(
            state_of(curve.coefficients[k], curve.frequency[k])
        )
        assert distance_between(found[k], truth) < tolerance, k
        if curve.event[k] != "fold":  # there the largest multiplier is 1
            assert curve.stable[k] == (np.abs(truth).max() < 1), k
