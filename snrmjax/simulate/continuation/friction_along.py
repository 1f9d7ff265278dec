"""Friction linearised along periodic motions: stiffness, internal variables, slip phases."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.model.effect_base import AbstractHysteresis
from snrmjax.model.elements import Elements, elements_of
from snrmjax.model.library.friction import AbstractSliders
from snrmjax.model.structures import Structure

SAMPLES = 512  # over a period, between which contact and slip events are located
_MOST_SLIPS = 8  # of one slider in a period


class Friction(NamedTuple):
    """Friction in the linearised motion; sliders are grouped by attachment point."""

    begin: Float[Array, " point"]  # phase at which the period starts
    stuck: Float[Array, "point mode mode"]  # 1/s², of stuck sliders beyond that of modes
    viscous: tuple[tuple[AbstractHysteresis, Elements], ...]  # memoryless
    internal: tuple["InternalVariables", ...]  # of laws with evolution equations
    attachments: Elements  # of the sliders, one force each
    owner: np.ndarray  # (slider,) the attachment point of each
    stiffness: Float[Array, "point slider"]  # 1/s²
    slip: "Slip"  # of the sliders


class Slip(NamedTuple):
    """When sliders slip, as phases after the start of the period."""

    at_first: Bool[Array, "point slider"]  # slipping before phase zero
    onsets: Float[Array, "event point slider"]  # infinite if there are fewer
    ends: Float[Array, "event point slider"]

    def slipping(self, phase: Float[Array, "step point"]) -> Bool[Array, "step point slider"]:
        """Whether sliders slip at phases."""

        def passed(events: Array) -> Array:
            # An end may lie a little before phase zero, and so before the end of the period.
            images = jnp.concatenate([events, events + 2 * jnp.pi])
            return jnp.sum(images[:, None] <= phase[None, :, :, None], axis=0)

        return self.at_first + passed(self.onsets) - passed(self.ends) > 0

    @property
    def slips(self) -> Bool[Array, "point slider"]:
        """The sliders that slip at all."""
        return self.at_first | jnp.isfinite(self.onsets[0])


class InternalVariables(NamedTuple):
    """A law with internal variables, linearised at equally spaced phases of motions."""

    attachment: Elements
    slopes: Float[Array, "sample point result argument"]  # of force and rates by x, ẋ, states
    unit: Float[Array, "point state"]  # scale of disturbed states, in units of x
    rate: Float[Array, "sample point"]  # velocity at the attachment point

    @property
    def n_states(self) -> int:
        """Number of internal variables."""
        return self.unit.shape[1]

    def at(self, phase: Float[Array, "time point"]) -> Float[Array, "time point result argument"]:
        """The derivatives at phases, by linear interpolation between samples."""
        position = phase / (2 * jnp.pi) * SAMPLES
        before = jnp.floor(position).astype(int)
        fraction = (position - before)[..., None, None]
        point = jnp.arange(phase.shape[1])
        one, two = (self.slopes[(before + k) % SAMPLES, point] for k in (0, 1))
        return (1 - fraction) * one + fraction * two

    def stiffness(self) -> Float[Array, "point mode mode"]:
        """Largest stiffness that the internal variables add while they follow the motion."""
        followed = self.slopes[:, :, 0, 2:] * self.slopes[:, :, 1:, 1]
        return self.attachment.matrix(jnp.max(jnp.abs(jnp.sum(followed, axis=-1)), axis=0)[:, None])


def _internal_variables_of(
    effects: AbstractHysteresis, attachment: Elements, x: Array, v: Array
) -> InternalVariables:
    """Internal variables of a law along motions (sample, point), one element for every point."""

    def of_point(effect: AbstractHysteresis, x: Array, v: Array) -> Array:
        def results(argument: Array, states: Array) -> Array:
            force = effect.state_force(argument[0], argument[1], states)
            return jnp.append(force, effect.state_rate(argument[0], argument[1], states))

        motion, states = jnp.stack([x, v], axis=1), effect.settled_states(x, v)
        by = jax.vmap(jax.jacfwd(results, argnums=(0, 1)))(motion, states)
        return jnp.concatenate(by, axis=-1)

    slopes = jax.vmap(of_point, (0, 1, 1), 1)(effects, x, v)
    unit = jnp.max(jnp.abs(slopes[:, :, 1:, 1]), axis=0)
    return InternalVariables(attachment, slopes, jnp.where(unit > 0, unit, 1.0), v)


def friction_along(model: Structure, coefficients: Array, frequency: Array) -> Friction:
    """Friction linearised along the motions.

    The period starts at the largest displacement of the first sliders' attachment point: there
    every one of them that slips at all is slipping, so its position is not a state of its own.
    """
    n_points, n = len(frequency), model.n_modes
    sliders = [e for e in model.hysteretic if isinstance(e, AbstractSliders)]
    others = [e for e in model.hysteretic if not isinstance(e, AbstractSliders)]
    distinct = list({effect.at: effect for effect in reversed(sliders)}.values())[::-1]
    attachments = elements_of(distinct, model.modes)
    nothing = jnp.zeros((n_points, n, n))
    begin = jnp.zeros_like(frequency)
    none = jnp.zeros((1, n_points, 0))
    no_sliders = none[0], Slip(none[0] > 0, none, none)
    if not model.hysteretic:
        return Friction(begin, nothing, (), (), attachments, np.zeros(0, int), *no_sliders)
    tau = 2 * jnp.pi * jnp.arange(SAMPLES) / SAMPLES
    phases = jnp.broadcast_to(tau[:, None], (SAMPLES, n_points))
    motions = states_at(coefficients, frequency, phases)

    def scaled(effect: AbstractHysteresis) -> tuple[AbstractHysteresis, Elements, Array, Array]:
        """The element scaled for every point, its attachment, displacement and velocity there."""
        attachment = elements_of([effect], model.modes)
        x, v = (attachment.displacement(part)[..., 0] for part in motions)
        half_range = 0.5 * (jnp.max(x, axis=0) - jnp.min(x, axis=0))
        typical = jnp.sqrt(jnp.mean(v**2, axis=0))
        return jax.vmap(effect.scaled_for)(half_range, typical), attachment, x, v

    with_states = [len(jax.eval_shape(effect.initial_states)) > 0 for effect in others]
    viscous = tuple(scaled(e)[:2] for e, has in zip(others, with_states, strict=True) if not has)
    internal = tuple(
        _internal_variables_of(*scaled(e))
        for e, has in zip(others, with_states, strict=True)
        if has
    )
    if not sliders:
        none_sliding = attachments, np.zeros(0, int), *no_sliders
        return Friction(begin, nothing, viscous, internal, *none_sliding)
    first = scaled(sliders[0])[2]
    largest = jnp.argmax(first, axis=0)
    reversal = jnp.take_along_axis(_reversals(first), largest[None], axis=0)[0] * tau[1]
    stiffness, slip, owner, stuck = [], [], [], nothing
    for effect in sliders:
        each, attachment, x, _ = scaled(effect)
        shifted = jax.vmap(lambda row, k: jnp.roll(row, -k), in_axes=(1, 0))(x, largest)
        position = jax.vmap(lambda e, x: e.settled_states(x, x))(each, shifted)
        slip_displacement = jax.vmap(lambda e: e.sliders().slip_displacement)(each)
        slip.append(
            jax.vmap(jax.vmap(_slip_of, (None, 1, 0)))(shifted, position, slip_displacement)
        )
        stiffness.append(jax.vmap(lambda e: e.sliders().stiffness)(each))
        owner += [[e.at for e in distinct].index(effect.at)] * stiffness[-1].shape[1]
        stuck = stuck + attachment.matrix(jax.vmap(lambda e: e.added_stiffness())(each)[:, None])
    at_first, onsets, ends = (jnp.concatenate(part, axis=1) for part in zip(*slip, strict=True))
    events = (jnp.moveaxis(part, 2, 0) - reversal[:, None] for part in (onsets, ends))
    return Friction(
        tau[largest] + reversal,
        stuck,
        viscous,
        internal,
        attachments,
        np.array(owner),
        jnp.concatenate(stiffness, axis=1),
        Slip(at_first, *events),
    )


def _reversals(x: Float[Array, "sample *batch"]) -> Float[Array, "sample *batch"]:
    """Extremum of a parabola through a sample and its neighbours, in samples from it."""
    ahead, behind = jnp.roll(x, -1, axis=0), jnp.roll(x, 1, axis=0)
    curvature = 2 * x - ahead - behind
    return jnp.clip(0.5 * (ahead - behind) / jnp.where(curvature != 0, curvature, 1.0), -0.5, 0.5)


def _slip_of(x: Array, position: Array, slip_displacement: Array) -> tuple[Array, Array, Array]:
    """Slip of one slider over a period: whether at first, phases of onsets and of ends.

    Slip starts where the spring's elongation reaches the slip displacement, and ends where the
    velocity of x changes sign, located by a parabola through three samples.
    """
    n = x.shape[0]
    width = 2 * jnp.pi / n
    moves = position != jnp.roll(position, -1)

    def phases(starts: Array, fraction: Array) -> Array:
        (index,) = jnp.nonzero(starts, size=_MOST_SLIPS, fill_value=n)
        known = index < n
        phase = (index + fraction[jnp.minimum(index, n - 1)]) * width
        return jnp.where(known, phase, jnp.inf)

    rise = jnp.roll(x, -1) - x
    reach = position + jnp.sign(rise) * slip_displacement
    onset = jnp.clip((reach - x) / jnp.where(rise != 0, rise, 1.0), 0.0, 1.0)
    before = jnp.roll(moves, 1)
    return before[0], phases(moves & ~before, onset), phases(before & ~moves, _reversals(x))


def viscous_slope(
    effects: AbstractHysteresis, x: Float[Array, "time point"], v: Float[Array, "time point"]
) -> Float[Array, "time point"]:
    """∂f/∂ẋ of friction without internal variables, one element for every point."""

    def slope(effect: AbstractHysteresis, x: Array, v: Array) -> Array:
        return jax.grad(effect.state_force, argnums=1)(x, v, effect.initial_states())

    return jax.vmap(lambda x, v: jax.vmap(slope)(effects, x, v))(x, v)


def states_at(coefficients: Array, frequency: Array, tau: Array) -> tuple[Array, Array]:
    """q and q̇ of all points at phases τ (time, point), as (time, point, mode)."""
    orders = jnp.arange(1, (coefficients.shape[1] - 1) // 2 + 1)
    # Powers of e^iτ by repeated doubling: cheaper than as many cosines.
    waves = jnp.exp(1j * tau)[..., None]
    while waves.shape[-1] < len(orders):
        waves = jnp.concatenate([waves, waves * waves[..., -1:]], axis=-1)
    cosine, sine = waves.real[..., : len(orders)], waves.imag[..., : len(orders)]
    mean, a, b = coefficients[:, 0], coefficients[:, 1::2], coefficients[:, 2::2]
    q = mean + jnp.einsum("tph,phm->tpm", cosine, a) + jnp.einsum("tph,phm->tpm", sine, b)
    rate = jnp.einsum("tph,phm->tpm", cosine, orders[:, None] * b)
    rate = rate - jnp.einsum("tph,phm->tpm", sine, orders[:, None] * a)
    return q, frequency[:, None] * rate
