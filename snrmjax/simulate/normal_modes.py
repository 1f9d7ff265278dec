"""Nonlinear normal modes: periodic motions of the conservative structure."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.model.structure import Structure, displacement_scale
from snrmjax.simulate.continuation import Curve, CurveStatus, StepControl, follow_curve
from snrmjax.simulate.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.harmonics import velocity_phasors

DEFAULT_STEPS = StepControl(first=1e-3, largest=0.02, angle=0.06)


class NormalModeBranch(NamedTuple):
    """A nonlinear normal mode as a curve of periodic motions, from small amplitude on."""

    frequency: Float[np.ndarray, " point"]  # rad/s
    coefficients: Float[np.ndarray, "point coefficient mode"]  # mean and cosines, kg^1/2 m
    velocity: Complex[np.ndarray, "point harmonic sensor"]  # m/s, h = 0…H
    energy: Float[np.ndarray, " point"]  # J
    status: CurveStatus
    sensors: tuple[str, ...]


def nonlinear_normal_mode(
    model: Structure,
    to_frequency: float,
    *,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    max_points: int = 4000,
    largest_amplitude: float | None = None,
    n_samples: int | None = None,
) -> NormalModeBranch:
    """Follow the nonlinear normal mode that starts at the linear mode of interest.

    Solves q̈ + ω²q + ∂V/∂q = 0 (damping, and forces of effects that depend on velocity, left
    out) for motions q = Σ a_h cos hΩt, which covers every motion that starts from rest; the
    curve is followed by arclength through folds and internal-resonance tongues.

    Arguments: `to_frequency` in rad/s, on either side of the linear frequency: the curve ends
    when it crosses it. `largest_amplitude` (kg^1/2 m; by default 30 times the displacement at
    which the mode's own nonlinearity matters) ends a curve that never does. A curve that first
    moves away from `to_frequency` is followed as long as it stays above a tenth and below ten
    times the linear frequency.
    Returns a `NormalModeBranch` whose `status` says how it ended.
    Reference: Kerschen et al., Mech. Syst. Signal Process. 23 (2009) 170,
    doi:10.1016/j.ymssp.2008.04.002.
    """
    j = model.modes.mode_of_interest
    omega = float(model.modes.natural_frequency[j])
    if not to_frequency > 0 or to_frequency == omega:
        raise ValueError(
            "`to_frequency` must be positive and differ from the linear frequency "
            f"{omega:g} rad/s, but is {to_frequency:g} rad/s."
        )
    scale = float(displacement_scale(model)[j])
    balance = harmonic_balance(
        model, 0.0, scale, harmonic_order=harmonic_order, n_samples=n_samples, cosine_only=True
    )
    upward = to_frequency > omega
    lower, upper = (omega / 10, to_frequency) if upward else (to_frequency, omega * 10)
    limit = 30.0 if largest_amplitude is None else largest_amplitude / scale
    ends = jnp.asarray([lower, upper, limit])
    curve = _follow(balance, ends, steps, max_points)
    return _assemble(balance, curve)


@eqx.filter_jit
def _follow(
    balance: HarmonicBalance,
    ends: Array,
    steps: StepControl,
    max_points: int,
) -> Curve:
    j = balance.model.modes.mode_of_interest
    modes, n = balance.model.modes, balance.model.n_modes
    # Start a little up the mode, where Newton's method at fixed amplitude is well posed.
    size = balance.size + 1
    linear = jnp.zeros(size).at[-1].set(modes.natural_frequency[j] / balance.frequency_scale)
    direction = jnp.zeros(size).at[n + j].set(1.0)
    return follow_curve(
        balance.linearised,
        linear + 1e-3 * direction,
        direction,
        ends[0] / balance.frequency_scale,
        ends[1] / balance.frequency_scale,
        ends[2],
        steps,
        max_points,
        start_across=direction,
    )


def _assemble(balance: HarmonicBalance, curve: Curve) -> NormalModeBranch:
    n = int(curve.n_points)
    frequency, coefficients, velocity, energy = (
        np.asarray(a)[:n] for a in _motion(balance, curve.points)
    )
    return NormalModeBranch(
        frequency=frequency,
        coefficients=coefficients,
        velocity=velocity,
        energy=energy,
        status=CurveStatus(int(curve.status)),
        sensors=balance.model.modes.sensors,
    )


@eqx.filter_jit
def _motion(balance: HarmonicBalance, points: Array) -> tuple[Array, Array, Array, Array]:
    """Frequency, coefficients, velocity and energy along a curve."""
    model = balance.model
    coefficients = jax.vmap(balance.coefficients)(points)
    frequency = points[:, -1] * balance.frequency_scale
    full = _with_sines(coefficients)
    velocity = velocity_phasors(full, frequency, model.modes.mode_shape)
    at_rest = jnp.sum(coefficients, axis=1)  # q(0), where the velocity vanishes
    return frequency, coefficients, velocity, model.potential_energy(at_rest)


def _with_sines(
    cosines: Float[Array, "point order mode"],
) -> Float[Array, "point coefficient mode"]:
    """Mean and cosines with zero sines in between."""
    pairs = jnp.stack([cosines[:, 1:], jnp.zeros_like(cosines[:, 1:])], axis=2)
    n_points, n_coefficients, n_modes = cosines.shape
    flat = pairs.reshape(n_points, 2 * (n_coefficients - 1), n_modes)
    return jnp.concatenate([cosines[:, :1], flat], axis=1)
