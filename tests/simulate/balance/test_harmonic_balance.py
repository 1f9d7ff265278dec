"""The balance: its Jacobian, exact residuals of known motions, and its scales."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from truths.kinds import KINDS, of_class, silent

from snrmjax.model.builders.beams import flat_beam
from snrmjax.model.effect_base import AbstractForce, AbstractMeasurementEffect
from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes, linear_response
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import simulated_structure, structure
from snrmjax.simulate.balance.harmonic_balance import (
    HarmonicBalance,
    harmonic_balance,
    linear_coefficients,
    resonance_displacement,
)
from snrmjax.simulate.balance.harmonics import velocity_phasors

FORCES = of_class(AbstractForce)
# Effects that change the balance other than by a force; of two internal resonances one.
OTHERS = {*KINDS} - {*FORCES, *of_class(AbstractMeasurementEffect), "internal_resonance_1_2"}


residual_of = eqx.filter_jit(HarmonicBalance.residual)


def one_mode(potential=None, effects=(), omega=2.0, ratio=0.05, participation=1.5):
    modes = linear_modes([omega], [ratio], [[1.0]], [participation])
    return structure(modes, polynomial_potential(potential or {}, 1), effects=effects)


def two_modes_with_effects(forces=FORCES, others=()):
    """With all forces, those not named at strength zero: one structure, compiled once."""
    modes = linear_modes([2.0, 5.0], [0.03, 0.01], [[1.0, 2.0]], [1.5, -0.5], mode_of_interest=1)
    every = {kind: of.parameters for kind, of in KINDS.items()}
    effects = [make_effect(k, every[k] if k in forces else silent(k, every[k])) for k in FORCES]
    effects += [make_effect(k, every[k]) for k in others]
    potential = polynomial_potential({"111": 0.5, "1122": 0.7, "222": -0.2}, 2)
    return simulated_structure(
        dataclasses.replace(
            structure(modes, potential, effects=tuple(effects)),
            test_order=jnp.asarray(0.6 if others else 0.0),
        )
    )


@eqx.filter_jit
def everything(balance, point, step):
    """Residual and Jacobian, also by automatic differentiation and by central differences."""
    shifts = step * jnp.eye(balance.size + 1)
    # One batch, hence one copy of the balance in the program.
    points = jnp.concatenate([point + shifts, point - shifts, point[None]])
    *moved, here = jnp.split(jax.vmap(balance.residual)(points), [len(shifts), 2 * len(shifts)])
    slope = (moved[0] - moved[1]).T / (2 * step)
    automatic = jax.jacfwd(balance.residual)(point)
    return *balance.linearised(point), here[0], automatic, slope


def assert_exact_jacobian(balance):
    point = 0.5 * np.random.default_rng(2).normal(size=balance.size + 1)
    point[-1] = 1.1
    residual, jacobian, slow, automatic, slope = everything(balance, jnp.asarray(point), 1e-5)
    assert jacobian.shape == (balance.size, balance.size + 1)
    largest = float(jnp.abs(jacobian).max())
    np.testing.assert_allclose(residual, slow, rtol=0, atol=1e-13 * largest)
    # The same sums in another order.
    np.testing.assert_allclose(jacobian, automatic, rtol=0, atol=1e-12 * largest)
    # A sixth of h² times the third derivative, 1e-10 of the largest entry, and rounding 1e-16/1e-5
    # of the residual's terms.
    np.testing.assert_allclose(jacobian, slope, rtol=0, atol=1e-8 * largest)
    return jacobian


@pytest.mark.parametrize(
    "options", [{"harmonic_order": 4}, {"harmonic_order": 5, "cosine_only": True}]
)
def test_jacobian_of_the_flat_beam_is_exact(options):
    assert_exact_jacobian(harmonic_balance(flat_beam(), 1e-2, 1e-5, **options))


@pytest.mark.parametrize("kind", FORCES)
def test_jacobian_of_every_force_is_exact(kind):
    settings = {"harmonic_order": 3}
    balance = harmonic_balance(two_modes_with_effects((kind,)), 1e-2, 1.0, **settings)
    with_force = assert_exact_jacobian(balance)
    without = harmonic_balance(two_modes_with_effects(()), 1e-2, 1.0, **settings)
    change = np.abs(with_force - assert_exact_jacobian(without)).max()
    assert change > 1e-2 if kind != "static_preload" else change == 0


@pytest.mark.long
@pytest.mark.parametrize("cosine_only", [False, True])
def test_jacobian_of_all_effects_together_is_exact(cosine_only):
    model = two_modes_with_effects(others=sorted(OTHERS))
    assert model.n_modes == 3  # with the mode of the internal resonance
    balance = harmonic_balance(model, 1e-2, 1.0, harmonic_order=3, cosine_only=cosine_only)
    assert_exact_jacobian(balance)
    if not cosine_only:  # three harmonics of force, each on the participations of the modes
        wanted = np.outer([0, 1, 0, 0.3, 0, -0.2, 0], [1.5, -0.5, 0.0])
        load = np.asarray(balance.load()).reshape(7, 3)
        np.testing.assert_allclose(load, wanted / 5.0**2, rtol=1e-14, atol=0)


def test_residual_by_vmap_agrees_and_traces_once():
    balance = harmonic_balance(one_mode({"1111": 0.3}), 1.0, 1.0, harmonic_order=3)
    points = jnp.asarray(np.random.default_rng(0).normal(size=(4, balance.size + 1)))
    traces = []

    @jax.jit
    def residuals(points):
        traces.append(1)
        return jax.vmap(balance.residual)(points)

    wanted = [residual_of(balance, point) for point in points]
    np.testing.assert_allclose(residuals(points), wanted, rtol=0, atol=1e-13)
    residuals(2 * points)
    assert len(traces) == 1


def test_linear_structure_is_solved_by_its_linear_response():
    modes = linear_modes(
        [2.0, 5.0], [0.03, 0.01], [[1.0, 2.0], [0.5, -1.0]], [1.5, -0.5], mode_of_interest=1
    )
    model, force, omega = structure(modes), jnp.array(0.7), jnp.array(2.3)
    exact = linear_coefficients(model, force, omega, 3)
    balance = harmonic_balance(model, force, 0.2, harmonic_order=3)
    residual = residual_of(balance, balance.point(exact, omega))
    np.testing.assert_allclose(residual, 0.0, atol=1e-15)  # rounding of terms of order one
    velocity = velocity_phasors(exact, omega, modes.mode_shape)
    np.testing.assert_allclose(velocity[1], linear_response(modes, omega, force), rtol=1e-13)
    assert not np.any(velocity[2:])
    # Sensitivity: the residual of another motion is its error times the stiffness.
    off = residual_of(balance, balance.point(1.001 * exact, omega))
    assert float(jnp.abs(off).max()) > 1e-4


# Motions q = A cos Ωt + B and the forces they need, derived by hand: the residual is
# (left side − load)/(ω_ref² · scale), coefficients (mean, c1, s1, c2, s2, c3, s3).
A, OMEGA, W, ZETA, LOAD = 0.8, 1.7, 2.0, 0.05, 1.5 * 0.9
LINEAR = np.array([0, (W**2 - OMEGA**2) * A - LOAD, -2 * ZETA * W * OMEGA * A, 0, 0, 0, 0])
KNOWN = {
    "cubic": ({"1111": 0.3}, (), 1.2 * A**3 * np.array([0, 0.75, 0, 0, 0, 0.25, 0])),
    "quadratic": ({"111": 0.4}, (), 1.2 * A**2 * np.array([0.5, 0, 0, 0.5, 0, 0, 0])),
    "cubic as an effect": (
        {},
        (make_effect("cubic_stiffness", {"coefficient": 1.2}),),
        1.2 * A**3 * np.array([0, 0.75, 0, 0, 0, 0.25, 0]),
    ),
    # c q²q̇ = −cΩA³ cos²τ sin τ = −cΩA³ (sin τ + sin 3τ)/4
    "van der Pol": (
        {},
        (make_effect("van_der_pol_damping", {"coefficient": 0.9}),),
        -0.9 * OMEGA * A**3 / 4 * np.array([0, 0, 1, 0, 0, 0, 1]),
    ),
    # c q̇³ = −cΩ³A³ (3 sin τ − sin 3τ)/4
    "cubic damping": (
        {},
        (make_effect("cubic_damping", {"coefficient": 0.9}),),
        -0.9 * (OMEGA * A) ** 3 / 4 * np.array([0, 0, 3, 0, 0, 0, -1]),
    ),
    "preload": (
        {},
        (make_effect("static_preload", {"constant_force": 0.6}),),
        0.6 * np.array([1, 0, 0, 0, 0, 0, 0]),
    ),
}


@pytest.mark.parametrize("name", KNOWN)
def test_residual_of_a_harmonic_motion_is_the_known_one(name):
    potential, effects, nonlinear = KNOWN[name]
    balance = harmonic_balance(one_mode(potential, effects), 0.9, 0.1, harmonic_order=3)
    x = jnp.zeros((7, 1)).at[1].set(A)
    residual = balance.residual(balance.point(x, jnp.array(OMEGA)))
    wanted = (LINEAR + nonlinear) / (W**2 * 0.1)
    np.testing.assert_allclose(residual, wanted, rtol=0, atol=1e-13)  # rounding


def test_point_and_coefficients_are_inverse():
    balance = harmonic_balance(flat_beam(), 1e-2, 3e-5, harmonic_order=2)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(5, 4)))
    point = balance.point(x, jnp.array(600.0))
    np.testing.assert_allclose(balance.coefficients(point), x, rtol=1e-15)
    assert float(point[-1]) == pytest.approx(600.0 / (2 * np.pi * 79.02), rel=1e-14)


def test_residual_does_not_depend_on_units():
    """Lengths in millimetres, times in milliseconds: same scaled point, same scaled residual."""
    point = jnp.asarray(np.random.default_rng(4).normal(size=8))
    balance = harmonic_balance(one_mode({"1111": 0.3, "111": 0.1}), 0.9, 0.5, harmonic_order=3)
    # q [kg^1/2 mm] = 1e3 q; c in (mm/ms²)/mm³ … : V [kg mm²/ms²] = V·1e6/1e6, so c_d = c/1e3^d.
    small = one_mode({"1111": 0.3e-12, "111": 0.1e-9}, omega=2.0e-3, participation=1.5)
    small_balance = harmonic_balance(small, 0.9e-3, 500.0, harmonic_order=3)
    np.testing.assert_allclose(
        small_balance.residual(point), balance.residual(point), rtol=0, atol=1e-13
    )


# -------------------------------------------------------------------------------------- set-up


def test_samples_by_default_and_on_request():
    assert harmonic_balance(one_mode(), 1.0, 1.0, harmonic_order=3).n_samples == 16
    assert harmonic_balance(one_mode({"1111": 1.0}), 1.0, 1.0, harmonic_order=9).n_samples == 40
    effect = (make_effect("gap_stiffness", {"stiffness": 1.0, "gap": 1.0}),)
    # Contact events are located between samples, by a cubic through four of them.
    assert harmonic_balance(one_mode({}, effect), 1.0, 1.0, harmonic_order=3).n_samples == 256
    effect = (make_effect("jenkins_slider", {"stiffness": 1.0, "slip_displacement": 1.0}),)
    assert harmonic_balance(one_mode({}, effect), 1.0, 1.0, harmonic_order=3).n_samples == 256
    effect = (make_effect("cubic_damping", {"coefficient": 1.0}),)
    assert harmonic_balance(one_mode({}, effect), 1.0, 1.0, harmonic_order=3).n_samples == 128
    assert harmonic_balance(one_mode({}, effect), 1.0, 1.0, harmonic_order=9).n_samples == 144
    assert harmonic_balance(one_mode(), 1.0, 1.0, harmonic_order=3, n_samples=7).n_samples == 7


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="`harmonic_order` must be 1 or more, but is 0"):
        harmonic_balance(one_mode(), 1.0, 1.0, harmonic_order=0)
    with pytest.raises(ValueError, match=r"`n_samples` must be above 6, .* but is 6"):
        harmonic_balance(one_mode(), 1.0, 1.0, harmonic_order=3, n_samples=6)


def test_resonance_displacement_solves_its_balance():
    force, participation, w = 0.9, 1.5, 2.0
    load = force * participation
    # The grid of amplitudes has steps of 6 %; between them it is interpolated to 1e-3.
    linear = resonance_displacement(one_mode(ratio=0.01), force)
    assert linear == pytest.approx(load / (2 * 0.01 * w * w), rel=1e-3)
    hard = resonance_displacement(one_mode({"1111": 0.3}, ratio=0.01), force)
    wanted = brentq(lambda q: 0.04 * np.sqrt(4 + 3 * 0.3 * q**2) * q - load, 1e-3, 1e3)
    assert hard == pytest.approx(wanted, rel=1e-3)
    drag = make_effect("quadratic_damping", {"coefficient": 0.6})
    # 8cΩQ/3π · ω Q = P
    wanted = np.sqrt(load * 3 * np.pi / (8 * 0.6)) / w
    assert resonance_displacement(one_mode({}, (drag,), ratio=0.0), force) == pytest.approx(
        wanted, rel=1e-3
    )
    # Never below the static displacement, and never the near-infinity of an undamped resonance.
    assert resonance_displacement(one_mode(ratio=0.9), force) == pytest.approx(load / w**2)
    assert resonance_displacement(one_mode(ratio=0.0), force) <= 1.001e4 * load / w**2
    modes = linear_modes([2.0, 1.0], [0.01, 0.01], [[1.0, 1.0]], [0.0, 3.0])
    # A force that does not drive the mode of interest: P/2ζω² of the mode that it drives.
    assert resonance_displacement(structure(modes), 2.0) == pytest.approx(300.0, rel=1e-3)
