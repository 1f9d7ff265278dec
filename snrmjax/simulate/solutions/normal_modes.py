"""Nonlinear normal modes: periodic motions of the conservative structure."""

import dataclasses
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractHysteresis
from snrmjax.model.structures import (
    Structure,
    displacement_scale,
    linear_terms_of,
    simulated_structure,
)
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import quantity
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.continuation.continuation import (
    Curve,
    CurveRange,
    StepControl,
    on_host,
    trace_curve,
)
from snrmjax.simulate.continuation.response_curve import MotionCurve, motions_of

DEFAULT_STEPS = StepControl(first=1e-3, largest=0.02, angle=0.06)
_TONGUE_SHARE = 0.05  # of the energy, in a harmonic of another mode: an internal resonance


class Tongue(NamedTuple):
    """A stretch of a normal mode on which a harmonic of it drives another mode in resonance."""

    mode: int  # the other mode, counted from zero
    harmonic: int
    from_frequency: float  # rad/s, lowest on the stretch
    to_frequency: float  # rad/s, highest
    energy_share: float  # largest share of the kinetic energy in that harmonic of that mode
    first: int  # index of its first point on the branch; with "skip", of the first one behind it
    last: int  # index of its last point; with "skip", of the last one before it


class NormalModeBranch(MotionCurve):
    """A nonlinear normal mode as a curve of periodic motions, from small amplitude on.

    Its motions start from rest: the coefficients are those of the mean and of cosines.
    """

    energy: Float[np.ndarray, " point"] = quantity("point", "J", "energy of the motion")
    tongues: tuple[Tongue, ...] = ()


def nonlinear_normal_mode(
    model: Structure,
    to_frequency: float,
    *,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    largest_amplitude: float | None = None,
    n_samples: int | None = None,
    tongues: Literal["follow", "skip"] = "follow",
) -> NormalModeBranch:
    """Trace the nonlinear normal mode that starts at the linear mode of interest.

    Solves m q̈ + k q + ∂V/∂q = 0 (damping, friction, and forces that depend on velocity, left out)
    for motions q = Σ a_h cos hΩt, which covers every motion that starts from rest; the
    curve is traced by arclength through folds and internal-resonance tongues.

    Arguments: `to_frequency` in rad/s, on either side of the linear frequency: the curve ends
    when it crosses it. `largest_amplitude` (kg^1/2 m; by default 30 times the displacement at
    which the mode's own nonlinearity matters) ends a curve that never does. A curve that first
    moves away from `to_frequency` is traced as long as it stays above a tenth and below ten
    times the linear frequency.
    Where a harmonic of the mode meets another mode, the curve runs out on a tongue and back: more
    than a twentieth of the energy is then in that harmonic of that mode. Tongues are reported;
    with `tongues="skip"` their points are left out, which leaves the backbone in pieces of one
    curve.
    Returns a `NormalModeBranch` whose `status` says how it ended.
    Raises `ValueError` for a frequency that is not positive or the linear one.
    Reference: Kerschen et al., Mech. Syst. Signal Process. 23 (2009) 170,
    doi:10.1016/j.ymssp.2008.04.002.
    """
    j = model.modes.mode_of_interest
    omega = model.modes.natural_frequency.item(j)
    if not to_frequency > 0 or to_frequency == omega:
        raise ValueError(
            "`to_frequency` must be positive and differ from the linear frequency "
            f"{omega:g} rad/s, but is {to_frequency:g} rad/s."
        )
    model = simulated_structure(model)
    kept = tuple(e for e in model.effects if not isinstance(e, AbstractHysteresis))
    model = dataclasses.replace(model, effects=kept)
    scale = float(displacement_scale(model)[j])
    balance = harmonic_balance(
        model, 0.0, scale, harmonic_order=harmonic_order, n_samples=n_samples, cosine_only=True
    )
    upward = to_frequency > omega
    lower, upper = (omega / 10, to_frequency) if upward else (to_frequency, omega * 10)
    limit = 30.0 if largest_amplitude is None else largest_amplitude / scale
    ends = np.array([lower, upper, limit])
    curve = on_host(_trace(balance, ends, steps))
    cosines, frequency = balance.motions(curve.points)
    at_rest = np.sum(cosines, axis=1)  # q(0), where the velocity vanishes
    (energy,) = by_blocks(lambda rows: (_energy(model, rows),), 128, at_rest)
    branch = NormalModeBranch(
        **motions_of(balance, curve.points),
        status=curve.status,
        energy=energy,
        tongues=_tongues(balance, frequency, cosines),
    )
    return _without_tongues(branch) if tongues == "skip" else branch


@compiled
def _trace(balance: HarmonicBalance, ends: Array, steps: StepControl) -> Curve:
    j = balance.model.modes.mode_of_interest
    modes, n = balance.model.modes, balance.model.n_modes
    # Start a little up the mode, where Newton's method at fixed amplitude is well posed.
    size = balance.size + 1
    linear = jnp.zeros(size).at[-1].set(modes.natural_frequency[j] / balance.frequency_scale)
    direction = jnp.zeros(size).at[n + j].set(1.0)
    lower, upper = ends[:2] / balance.frequency_scale
    return trace_curve(
        balance.linearised,
        linear + 1e-3 * direction,
        direction,
        CurveRange(lower, upper, largest_amplitude=ends[2]),
        steps,
        start_across=direction,
    )


def _tongues(
    balance: HarmonicBalance, frequency: np.ndarray, coefficients: np.ndarray
) -> tuple[Tongue, ...]:
    """Stretches with more than `_TONGUE_SHARE` of the kinetic energy in one other pair."""
    j, mass = balance.model.modes.mode_of_interest, np.asarray(linear_terms_of(balance.model).mass)
    order = np.arange(coefficients.shape[1])[:, None]
    energy = mass * (order * coefficients) ** 2  # twice the mean kinetic energy, over Ω²
    share = energy / np.maximum(energy.sum(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
    # The mode's own harmonics are its shape in time; others' fundamentals its shape in space.
    share[:, :, j] = 0.0
    share[:, :2] = 0.0
    strongest = share.max(axis=(1, 2))
    inside = np.concatenate([[False], strongest > _TONGUE_SHARE, [False]])
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    found = []
    for first, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        stretch = share[first:stop].max(axis=0)
        harmonic, mode = np.unravel_index(np.argmax(stretch), stretch.shape)
        found.append(
            Tongue(
                mode=int(mode),
                harmonic=int(harmonic),
                from_frequency=float(frequency[first:stop].min()),
                to_frequency=float(frequency[first:stop].max()),
                energy_share=float(stretch.max()),
                first=first,
                last=stop - 1,
            )
        )
    return tuple(found)


def _without_tongues(branch: NormalModeBranch) -> NormalModeBranch:
    """The branch without the points of its tongues, which say between which points they were."""
    keep = np.ones(len(branch.frequency), dtype=bool)
    for tongue in branch.tongues:
        keep[tongue.first : tongue.last + 1] = False
    place = np.cumsum(keep)  # points that are kept up to and with each
    return dataclasses.replace(
        branch,
        frequency=branch.frequency[keep],
        coefficients=branch.coefficients[keep],
        velocity=branch.velocity[keep],
        energy=branch.energy[keep],
        tongues=tuple(
            tongue._replace(first=int(place[tongue.first]), last=int(place[tongue.first]) - 1)
            for tongue in branch.tongues
        ),
    )


@compiled
def _energy(model: Structure, displacement: Array) -> Array:
    return model.potential_energy(displacement)
