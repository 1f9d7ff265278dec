"""Forced responses that an identified backbone predicts: resonances and whole curves."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.identify.backbone import Backbone
from snrmjax.identify.snrm import nonlinear_mode_velocity
from snrmjax.model.modes import LinearModes, residual_velocity

CONTINUED = 1.5
"""Curves are continued up to this multiple of the largest measured amplitude."""

_SCAN = 4096


class Resonance(NamedTuple):
    """A phase resonance under a given force: the nonlinear mode moves in phase with it."""

    force: float  # N
    amplitude: float  # of the backbone's argument, m or m/s
    frequency: float  # rad/s
    damping_ratio: float
    velocity: float  # m/s at the backbone's sensor, residual modes included
    continued: bool  # beyond the measured amplitudes


class PredictedResponse(NamedTuple):
    """One connected response curve in order: up the low-frequency side, down the other."""

    force: float  # N
    frequency: Float[np.ndarray, " point"]  # rad/s
    velocity: Complex[np.ndarray, " point"]  # m/s at the backbone's sensor
    amplitude: Float[np.ndarray, " point"]  # of the backbone's argument
    stable: Bool[np.ndarray, " point"]
    branch: tuple[str, ...]  # "lead" (velocity leads the force) or "lag" for every point
    continued: Bool[np.ndarray, " point"]  # beyond the measured amplitudes
    isolated: bool  # a closed curve, apart from the main one


def resonances(backbone: Backbone, modes: LinearModes, force: float) -> list[Resonance]:
    """All phase resonances under a force, by Newton's method from every sign change.

    At resonance Ω = ω̃ and the velocity amplitude of the mode is v = |A|F/(2ζ̃ω̃), both functions
    of amplitude; the total adds the residual modes. Damping that falls with amplitude can give
    several solutions.

    Arguments: `force` in N. Returns the solutions in order of amplitude, up to `CONTINUED` times
    the largest measured amplitude; an empty list when none lies there.
    Raises `ValueError` for a force that is not positive.
    Reference: Kwarta & Allen, Eq. (19).
    """
    _require_force(force)
    amplitude = _scan(backbone)
    excess = np.asarray(_resonance_excess(backbone, jnp.asarray(amplitude), jnp.asarray(force)))
    at = np.flatnonzero(np.signbit(excess[:-1]) != np.signbit(excess[1:]))
    found = []
    for k in at:
        low, high = amplitude[k], amplitude[k + 1]
        start = low - excess[k] * (high - low) / (excess[k + 1] - excess[k])
        root, good = _newton_resonance(backbone, jnp.asarray(force), start, low, high)
        if bool(good):
            found.append(_resonance(backbone, modes, force, float(root)))
    return found


def resonance_by_fixed_point(
    backbone: Backbone,
    modes: LinearModes,
    force: float,
    *,
    start: float | None = None,
    max_steps: int = 256,
) -> Resonance | None:
    """One phase resonance by the paper's fixed-point iteration v ← |A|F/(2ζ̃ω̃)(v).

    Arguments: `force` in N; `start` the first amplitude (of the backbone's argument), by default
    the largest measured one. Returns None when the iteration does not converge, which happens
    where damping changes fast with amplitude: use `resonances`.
    Reference: Kwarta & Allen, Eq. (19).
    """
    _require_force(force)
    first = jnp.asarray(float(backbone.largest) if start is None else start)
    root, good = _picard(backbone, jnp.asarray(force), first, max_steps)
    largest = CONTINUED * float(backbone.largest)
    if not bool(good) or not 0 < float(root) <= largest:
        return None
    return _resonance(backbone, modes, force, float(root))


def predict_response(
    backbone: Backbone,
    modes: LinearModes,
    force: float,
    *,
    from_frequency: float = 0.0,
    to_frequency: float = np.inf,
    points_per_side: int = 200,
    smallest_fraction: float = 0.02,
) -> list[PredictedResponse]:
    """The whole response to a force, both sides of resonance and the unstable part included.

    With the amplitude as parameter the frequency has a closed form: for a displacement X
    Ω² = ω̃² − δ²/2 ± √((|A|F/X)² − δ²ω̃² + δ⁴/4), δ = 2ζ̃ω̃, and likewise for a velocity. A point
    is unstable where, at fixed frequency, a larger amplitude needs less force, or where the
    damping of small changes of amplitude is negative: both follow from the averaged equations.

    Arguments: `force` in N, frequencies in rad/s; `points_per_side` on either side of every
    resonance; the main curve starts at `smallest_fraction` of its largest amplitude.
    Returns the connected curves, the main one first, isolated ones after it.
    Reference: Kwarta & Allen, section 2.2 and Eq. (10).
    """
    _require_force(force)
    scan = _scan(backbone)
    load = jnp.abs(backbone.modal_constant) * force
    inside = np.asarray(_branches(backbone, jnp.asarray(scan), load)[2]) >= 0
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    starts = [scan[0]] if inside[0] else []
    ends: list[float] = []
    for k in edges:
        low, high = scan[k], scan[k + 1]
        for _ in range(60):
            middle = 0.5 * (low + high)
            same = (_margin(backbone, middle, load) >= 0) == inside[k]
            low, high = (middle, high) if same else (low, middle)
        (ends if inside[k] else starts).append(low if inside[k] else high)
    if inside[-1]:
        ends.append(scan[-1])
    curves = []
    for number, (low, high) in enumerate(zip(starts, ends, strict=True)):
        main = number == 0 and bool(inside[0])
        curve = _one_curve(
            backbone,
            modes,
            force,
            max(low, smallest_fraction * high) if main else low,
            high,
            points_per_side,
            closed=not main,
        )
        keep = (curve.frequency >= from_frequency) & (curve.frequency <= to_frequency)
        # A range that cuts the peak off leaves two pieces, which no line may join.
        runs = np.split(np.arange(len(keep)), np.flatnonzero(np.diff(keep.astype(int))) + 1)
        curves += [_subset(curve, run) for run in runs if run.size and keep[run[0]]]
    return curves


def _require_force(force: float) -> None:
    if not force > 0 or not np.isfinite(force):
        raise ValueError(f"`force` must be positive, but is {force!r} N.")


def _scan(backbone: Backbone) -> Float[np.ndarray, " point"]:
    """Amplitudes from zero to the end of the continued curve."""
    return CONTINUED * float(backbone.largest) * np.linspace(0.0, 1.0, _SCAN + 1)


@eqx.filter_jit
def _resonance_excess(backbone: Backbone, amplitude: Array, force: Array) -> Array:
    """v·2ζ̃ω̃ − |A|F: zero at a phase resonance."""
    load = jnp.abs(backbone.modal_constant) * force
    return backbone.velocity(amplitude) * backbone.modal_damping(amplitude) - load


@eqx.filter_jit
def _newton_resonance(
    backbone: Backbone, force: Array, start: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """The root in a bracket, in units of its upper end."""
    load = jnp.abs(backbone.modal_constant) * force

    def equation(share: Array, _: None) -> Array:
        return _resonance_excess(backbone, share * high, force) / load

    solution: optx.Solution = optx.root_find(
        equation,
        optx.Newton(rtol=1e-12, atol=1e-12),
        jnp.asarray(start / high),
        options={"lower": jnp.asarray(low / high), "upper": jnp.asarray(1.0)},
        max_steps=64,
        throw=False,
    )
    good = (solution.result == optx.RESULTS.successful) & jnp.isfinite(solution.value)
    return solution.value * high, good


@eqx.filter_jit
def _picard(backbone: Backbone, force: Array, start: Array, max_steps: int) -> tuple[Array, Array]:
    load = jnp.abs(backbone.modal_constant) * force

    def update(amplitude: Array, _: None) -> Array:
        velocity = load / backbone.modal_damping(amplitude)
        if backbone.argument == "velocity":
            return velocity
        return velocity / backbone.natural_frequency(amplitude)

    solution: optx.Solution = optx.fixed_point(
        update,
        optx.FixedPointIteration(rtol=1e-10, atol=1e-14),
        start,
        max_steps=max_steps,
        throw=False,
    )
    good = (solution.result == optx.RESULTS.successful) & jnp.isfinite(solution.value)
    return solution.value, good


def _resonance(backbone: Backbone, modes: LinearModes, force: float, amplitude: float) -> Resonance:
    at = jnp.asarray(amplitude)
    frequency, damping = backbone.natural_frequency(at), backbone.damping_ratio(at)
    velocity = _velocity(backbone, modes, force, frequency, frequency, damping)
    return Resonance(
        force=force,
        amplitude=amplitude,
        frequency=float(frequency),
        damping_ratio=float(damping),
        velocity=float(jnp.abs(velocity)),
        continued=amplitude > float(backbone.largest) * (1 + 1e-9),
    )


def _velocity(
    backbone: Backbone,
    modes: LinearModes,
    force: float,
    frequency: Array,
    natural_frequency: Array,
    damping_ratio: Array,
) -> Complex[Array, "*batch"]:
    r = modes.sensors.index(backbone.sensor)
    own = nonlinear_mode_velocity(
        backbone.modal_constant * force, natural_frequency, damping_ratio, frequency
    )
    load = jnp.broadcast_to(force, frequency.shape)
    return own + residual_velocity(modes, frequency, load)[..., r]


@eqx.filter_jit
def _branches(backbone: Backbone, amplitude: Array, load: Array) -> tuple[Array, Array, Array]:
    """Squared frequencies below and above resonance, and the margin that must not be negative."""
    squared, damping = backbone.squared_frequency(amplitude), backbone.modal_damping(amplitude)
    if backbone.argument == "displacement":
        middle = squared - 0.5 * damping**2
        margin = (load / amplitude) ** 2 - damping**2 * squared + 0.25 * damping**4
    else:
        middle = squared + 0.5 * ((load / amplitude) ** 2 - damping**2)
        margin = middle**2 - squared**2
        # Without real frequencies the product of the roots, ω̃⁴, still lets both be negative.
        margin = jnp.where(middle > 0, margin, -jnp.abs(margin))
    root = jnp.sqrt(jnp.maximum(margin, 0.0))
    return middle - root, middle + root, margin


def _margin(backbone: Backbone, amplitude: float, load: Array) -> float:
    return float(_branches(backbone, jnp.asarray(amplitude), load)[2])


@eqx.filter_jit
def _is_stable(backbone: Backbone, amplitude: Array, frequency: Array) -> Array:
    """Stability of the averaged equations at (amplitude, Ω)."""

    def squared_force(a: Array, omega: Array) -> Array:
        squared, damping = backbone.squared_frequency(a), backbone.modal_damping(a)
        scale = a if backbone.argument == "displacement" else a / omega
        return scale**2 * ((squared - omega**2) ** 2 + (damping * omega) ** 2)

    def one(a: Array, omega: Array) -> Array:
        damping, slope = jax.value_and_grad(backbone.modal_damping)(a)
        return (jax.grad(squared_force)(a, omega) > 0) & (2 * damping + a * slope > 0)

    return jax.vmap(one)(amplitude, frequency)


def _one_curve(
    backbone: Backbone,
    modes: LinearModes,
    force: float,
    low: float,
    high: float,
    points_per_side: int,
    *,
    closed: bool,
) -> PredictedResponse:
    load = jnp.abs(backbone.modal_constant) * force
    # Points crowd where both sides meet: there the frequency changes with a square root.
    angle = np.linspace(0.0, 1.0, points_per_side)
    share = 0.5 * (1 - np.cos(np.pi * angle)) if closed else np.sin(0.5 * np.pi * angle)
    amplitude = low + (high - low) * share
    below, above, _ = (np.asarray(a) for a in _branches(backbone, jnp.asarray(amplitude), load))
    both = np.concatenate([amplitude, amplitude[::-1]])
    squared = np.concatenate([below, above[::-1]])
    # Points without a real frequency are dropped at the end: every force has the same shapes,
    # and the functions below are compiled once.
    keep = squared > 0
    frequency = np.sqrt(np.where(keep, squared, 1.0))
    at, omega = jnp.asarray(both), jnp.asarray(frequency)
    natural, damping = backbone.natural_frequency(at), backbone.damping_ratio(at)
    velocity = np.asarray(_velocity(backbone, modes, force, omega, natural, damping))
    curve = PredictedResponse(
        force=force,
        frequency=frequency,
        velocity=velocity,
        amplitude=both,
        stable=np.asarray(_is_stable(backbone, at, omega)),
        branch=tuple(np.where(frequency <= np.asarray(natural), "lead", "lag").tolist()),
        continued=both > float(backbone.largest) * (1 + 1e-9),
        isolated=closed,
    )
    return _subset(curve, keep)


def _subset(curve: PredictedResponse, keep: np.ndarray) -> PredictedResponse:
    return curve._replace(
        frequency=curve.frequency[keep],
        velocity=curve.velocity[keep],
        amplitude=curve.amplitude[keep],
        stable=curve.stable[keep],
        branch=tuple(np.asarray(curve.branch)[keep].tolist()),
        continued=curve.continued[keep],
    )
