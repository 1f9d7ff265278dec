"""Monodromy matrices: what small disturbances of a periodic motion become over one period."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.model.effect_base import (
    AbstractForce,
    AbstractHysteresis,
    AbstractKinked,
    AbstractMemoryless,
)
from snrmjax.model.effect_metadata import Argument
from snrmjax.model.elements import Elements, elements_of
from snrmjax.model.kinks import crossings
from snrmjax.model.library.friction import AbstractSliders
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import compiled

_MOST_SEGMENTS = 256
_SEGMENT = 32  # steps whose propagators, or kicks, are computed side by side
_KICKS = 3  # for every step of Magnus' method
_LEAST_KICKS = 240
_FEW_SLIDERS = 16  # whose slip begins and ends with a step
_MOST_SLIPS = 8  # of one slider in a period
_SAMPLES = 512  # over a period, among which contacts and slip are looked for
_GAUSS = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])


class _Friction(NamedTuple):
    """Friction's part in the linearised motion; sliders by the places at which they act."""

    begin: Float[Array, " point"]  # phase at which the period begins
    stuck: Float[Array, "point mode mode"]  # stiffness of springs that the modes do not hold, 1/s²
    viscous: tuple[tuple[AbstractHysteresis, Elements], ...]  # without memory, one of every point
    places: Elements  # of the sliders, one force each
    owner: np.ndarray  # (slider,) the place of each
    stiffness: Float[Array, "point slider"]  # 1/s²
    slip: "_Slip"  # of the sliders


class _Slip(NamedTuple):
    """When sliders are dragged, by phases behind the beginning of the period."""

    at_first: Bool[Array, "point slider"]  # dragged before phase zero
    onsets: Float[Array, "event point slider"]  # infinite where there are fewer
    ends: Float[Array, "event point slider"]

    def dragged(self, phase: Float[Array, "step point"]) -> Bool[Array, "step point slider"]:
        """Whether sliders are dragged at phases."""

        def passed(events: Array) -> Array:
            # An end may lie a little before phase zero, and so before the end of the period.
            images = jnp.concatenate([events, events + 2 * jnp.pi])
            return jnp.sum(images[:, None] <= phase[None, :, :, None], axis=0)

        return self.at_first + passed(self.onsets) - passed(self.ends) > 0

    @property
    def slips(self) -> Bool[Array, "point slider"]:
        """The sliders that are dragged at all."""
        return self.at_first | jnp.isfinite(self.onsets[0])


@partial(compiled, long_loops=True)
def monodromy(
    model: Structure,
    coefficients: Float[Array, "point coefficient mode"],
    frequency: Float[Array, " point"],
    steps_per_cycle: Float[Array, ""],
) -> Float[Array, "point state state"]:
    """The linearised map of (δq, δq̇ over the fastest natural frequency) over one period.

    Behind them stand the positions of sliders at other places than the first one's, where there
    are any. NaN where more steps would be needed than any sensible motion needs.
    """
    if not all(map(_is_spring, model.forces)) or model.modes.damping_coupling is not None:
        return _by_magnus(model, coefficients, frequency, steps_per_cycle)
    return _by_kicks(model, coefficients, frequency, steps_per_cycle)


def _is_spring(force: AbstractForce) -> bool:
    """Whether a force is a smooth function of the displacement, as a potential's is."""
    smooth = isinstance(force, AbstractMemoryless) and not isinstance(force, AbstractKinked)
    shape = type(force).shape
    return smooth and shape is not None and shape.argument is Argument.DISPLACEMENT


def _by_kicks(
    model: Structure, coefficients: Array, frequency: Array, steps_per_cycle: Array
) -> Float[Array, "point state state"]:
    """The map of springs and potential: oscillators that a varying stiffness kicks equally often.

    Between kicks every mode moves by itself with its own damping and mean tangent stiffness,
    which is exact; the kicks hold what varies and what couples, K(t). With K − h²K²/12 in place of
    K the map is that of a fourth-order method but for a change of coordinates, which its
    eigenvalues do not see. Points lie along the last axis, so that one instruction works on
    several.
    Reference: Takahashi & Imada, J. Phys. Soc. Jpn. 53 (1984) 3765, doi:10.1143/JPSJ.53.3765;
    López-Marcos, Sanz-Serna & Skeel, SIAM J. Sci. Comput. 18 (1997) 223,
    doi:10.1137/S1064827595288085.
    """
    n, n_points, modes = model.n_modes, frequency.shape[0], np.arange(model.n_modes)
    terms = model.linear_terms()
    orders = np.arange(1, (coefficients.shape[1] - 1) // 2 + 1)
    rows = jnp.moveaxis(coefficients, 0, 2).reshape(coefficients.shape[1], n * n_points)
    per_mass = (terms.mass[:, None] * frequency**2)[:, None, :]
    springs = elements_of(model.forces, model.modes)

    def stiffness(tau: Array) -> Float[Array, "time mode mode point"]:
        """The nonlinear part of the tangent stiffness over mΩ²."""
        angle = tau[:, None] * orders
        waves = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=2).reshape(len(tau), -1)
        q = (rows[0] + waves @ rows[1:]).reshape(len(tau), n, n_points)
        columns = jnp.moveaxis(q, 1, 0).reshape(n, -1)
        tangent = model.potential.stiffness_of_rows(columns)
        if model.forces:
            x = springs.displacement(columns.T)
            of_springs = springs.matrix(springs.slopes(x, jnp.zeros_like(x)).stiffness)
            tangent = tangent + jnp.moveaxis(of_springs, 0, 2)
        return jnp.moveaxis(tangent.reshape(n, n, len(tau), n_points), 2, 0) / per_mass

    varying = stiffness(2 * jnp.pi * jnp.arange(48) / 48)
    mean = jnp.mean(varying, axis=0)[modes, modes]
    linear = terms.stiffness[:, None] / per_mass[:, 0]
    rate = jnp.max(jnp.sum(jnp.abs(varying.at[:, modes, modes].add(linear)), axis=2))
    kicks = jnp.maximum(_KICKS * steps_per_cycle * jnp.nan_to_num(jnp.sqrt(rate)), _LEAST_KICKS)
    n_segments, step = _segments(kicks, _KICKS * _MOST_SEGMENTS)
    speed = jnp.max(terms.stiffness / terms.mass) ** 0.5 / frequency  # of δq̇, over Ω
    damping = terms.damping[:, None] / (terms.mass[:, None] * frequency)
    stay, go, back, last = (
        part[:, None] for part in _oscillation(linear + mean, damping, step, speed)
    )

    def kick(state: tuple, stiffness: Array) -> tuple[tuple, None]:
        q, v = state
        q, v = stay * q + go * v, back * q + last * v
        return (q, v - sum(stiffness[:, j, None] * q[j] for j in range(n))), None

    def segment(number: Array, state: tuple) -> tuple:
        tau = (number * _SEGMENT + jnp.arange(_SEGMENT) + 0.5) * step
        k = stiffness(tau).at[:, modes, modes].add(-mean)
        square = sum(k[:, :, j, None] * k[:, None, j] for j in range(n))
        return jax.lax.scan(kick, state, (k - step**2 / 12 * square) * (step / speed))[0]

    eye = jnp.broadcast_to(jnp.eye(2 * n)[:, :, None], (2 * n, 2 * n, n_points))
    found = jnp.concatenate(jax.lax.fori_loop(0, n_segments, segment, (eye[:n], eye[n:])))
    return jnp.where(n_segments > 0, jnp.moveaxis(found, 2, 0), jnp.nan)


def _segments(steps: Array, most: int) -> tuple[Array, Array]:
    """So many segments of steps for one period, none when they are too many; and the step."""
    needed = jnp.ceil(steps / _SEGMENT)
    # A motion that needs more is so far off that its tangents overflow anyway.
    n_segments = jnp.where(needed <= most, needed, 0).astype(int)
    return n_segments, 2 * jnp.pi / (n_segments * _SEGMENT)


def _oscillation(stiffness: Array, damping: Array, step: Array, speed: Array) -> tuple:
    """(q, q̇/speed) after a step from either: y″ + damping y′ + stiffness y = 0, of any sign."""
    squared = stiffness - 0.25 * damping**2
    rate = jnp.sqrt(jnp.maximum(jnp.abs(squared), 1e-16))
    swings = squared > 0
    even = jnp.where(swings, jnp.cos(rate * step), jnp.cosh(rate * step))
    odd = jnp.where(swings, jnp.sin(rate * step), jnp.sinh(rate * step)) / rate
    left = jnp.exp(-0.5 * damping * step)
    stay, last = even + 0.5 * damping * odd, even - 0.5 * damping * odd
    return left * stay, left * odd * speed, -left * stiffness * odd / speed, left * last


def _by_magnus(
    model: Structure, coefficients: Array, frequency: Array, steps_per_cycle: Array
) -> Float[Array, "point state state"]:
    """The map of a structure whose forces depend on velocity or history, in small steps.

    Magnus' method of order 6 with steps that resolve the fastest tangent frequency of all points.
    The propagators of a segment of steps are computed side by side and then applied one after the
    other.
    Reference: Blanes, Casas & Ros, BIT 40 (2000) 434, Eq. (3.10), doi:10.1023/A:1022311628317.
    """
    n, n_points = model.n_modes, frequency.shape[0]
    terms = model.linear_terms()
    friction = _friction(model, coefficients, frequency)
    phases = 2 * jnp.pi * jnp.arange(48)[:, None] / 48
    k, c = _tangents(model, friction, coefficients, frequency, phases)
    rate = jnp.sqrt(jnp.max(jnp.sum(jnp.abs(k), axis=-1)))
    cycles = jnp.nan_to_num(jnp.maximum(rate, 0.5 * jnp.max(jnp.sum(jnp.abs(c), axis=-1))))
    n_segments, step = _segments(jnp.maximum(steps_per_cycle * cycles, 512), _MOST_SEGMENTS)
    contacts = _contacts(model, coefficients, frequency, friction.begin)
    if 0 < friction.owner.size <= _FEW_SLIDERS:
        few = [jnp.moveaxis(part, 2, 1) for part in (friction.slip.onsets, friction.slip.ends)]
        contacts = jnp.concatenate([contacts, *(part.reshape(-1, n_points) for part in few)])
    unit = jnp.sqrt(jnp.max(terms.stiffness / terms.mass)) / frequency  # of δq̇, over Ω
    places, owner, n_places = friction.places, friction.owner, friction.places.n_places
    size = 2 * n + n_places
    of_place = np.eye(n_places)[owner]  # (slider, place)

    def generators(start: Array, length: Array, held: Array) -> Array:
        """The matrices A of y' = A y at the Gauss points of a segment's steps."""
        tau = start[:, None] + length[:, None] * _GAUSS[:, None]
        tau = friction.begin + tau.reshape(-1, n_points)
        k, c = _tangents(model, friction, coefficients, frequency, tau)
        a = jnp.zeros((len(tau), n_points, size, size))
        if n_places:
            loose = jnp.where(held, 0.0, friction.stiffness) @ of_place
            moving = places.matrix(jnp.repeat(loose, 3, axis=0))
            k = k - moving / (terms.mass * frequency[:, None] ** 2)[..., None]
            pulls = jnp.broadcast_to(places.rows.T, (n, n_places)) / terms.mass[:, None]
            a = a.at[:, :, n : 2 * n, 2 * n :].set(pulls / (unit * frequency**2)[:, None, None])
        modes = np.arange(n)
        a = a.at[:, :, modes, n + modes].set(unit[:, None])
        a = a.at[:, :, n : 2 * n, :n].set(-k / unit[:, None, None])
        a = a.at[:, :, n : 2 * n, n : 2 * n].set(-c)
        return a.reshape(_SEGMENT, 3, n_points, size, size)

    def segment(number: Array, state: tuple) -> tuple:
        ends = _step_ends(number * _SEGMENT + jnp.arange(_SEGMENT + 1), step, contacts)
        held = ~friction.slip.dragged(0.5 * (ends[1:] + ends[:-1]))
        length = ends[1:] - ends[:-1]
        per_step = generators(ends[:-1], length, held)
        propagators = _magnus(per_step, length[..., None, None])

        def advance(state: tuple, item: tuple) -> tuple[tuple, None]:
            y, z = state
            propagator, stuck = item
            if not n_places:
                return (propagator @ y, z), None
            held_by = jnp.where(stuck, friction.stiffness, 0.0)[:, :, None] * z
            pull = of_place.T @ held_by
            y = propagator[:, : 2 * n, : 2 * n] @ y + propagator[:, : 2 * n, 2 * n :] @ pull
            return (y, jnp.where(stuck[:, :, None], z, sliding(y))), None

        return jax.lax.scan(advance, state, (propagators, held))[0]

    def sliding(y: Array) -> Array:
        """The motion of every slider's place."""
        there = places.displacement(jnp.swapaxes(y[:, :n], 1, 2))
        return jnp.swapaxes(there, 1, 2)[:, owner]

    # Sliders at the first place follow from its motion; others have positions of their own.
    free = np.flatnonzero(owner > 0)
    y = jnp.broadcast_to(jnp.eye(2 * n, 2 * n + free.size), (n_points, 2 * n, 2 * n + free.size))
    z = jnp.zeros((n_points, owner.size, 2 * n + free.size))
    slips = friction.slip.slips[:, :, None]
    if n_places:
        start = sliding(y).at[:, free].set(np.eye(2 * n + free.size)[2 * n :])
        z = jnp.where(slips, start, 0.0)
    y, z = jax.lax.fori_loop(0, n_segments, segment, (y, z))
    whole = jnp.concatenate([y, jnp.where(slips, z, 0.0)[:, free]], axis=1)
    return jnp.where(n_segments > 0, whole, jnp.nan)


def _contacts(
    model: Structure, coefficients: Array, frequency: Array, begin: Array
) -> Float[Array, "contact point"]:
    """Phases behind `begin` at which contacts open and close; infinite where there are fewer."""
    tau = 2 * jnp.pi * jnp.arange(_SAMPLES) / _SAMPLES
    phases = begin + tau[:, None]
    q, _ = _states_at(coefficients, frequency, phases)
    found = [jnp.zeros((0, len(frequency)))]
    for effect in model.memoryless:
        if isinstance(effect, AbstractKinked):
            x = elements_of([effect], model.modes).displacement(q)[..., 0]
            for place in effect.kinks().displacement:
                there = jax.vmap(crossings, (1, None), 1)(x, place)
                phase = (there.interval + there.share) * tau[1]
                found.append(jnp.where(there.passes, phase, jnp.inf))
    return jnp.concatenate(found)


def _step_ends(number: Array, step: Array, contacts: Array) -> Float[Array, "end point"]:
    """Phases at the ends of steps: equally spaced, the nearest to each contact moved onto it.

    No step then holds a jump of the stiffness but one of two contacts closer than half a step.
    """
    even = number * step
    if not len(contacts):
        return jnp.broadcast_to(even[:, None], (len(number), contacts.shape[1]))
    near = jnp.round(contacts / step) == number[:, None, None]
    inner = (number > 0) & (even < 2 * jnp.pi - 0.5 * step)
    chosen = jnp.take_along_axis(contacts[None], jnp.argmax(near, axis=1)[:, None], axis=1)[:, 0]
    moved = jnp.any(near, axis=1) & inner[:, None]
    return jnp.where(moved, chosen, even[:, None])


def _magnus(
    generators: Float[Array, "step gauss point state state"], step: Array
) -> Float[Array, "step point state state"]:
    """Propagators over steps from y' = A(t) y at their three Gauss points."""

    def bracket(a: Array, b: Array) -> Array:
        return a @ b - b @ a

    first, middle, last = (step * generators[:, i] for i in range(3))
    slope = np.sqrt(15.0) / 3.0 * (last - first)
    bend = 10.0 / 3.0 * (last - 2 * middle + first)
    inner = bracket(middle, slope)
    outer = -bracket(middle, 2 * bend + inner) / 60.0
    exponent = middle + bend / 12.0
    exponent = exponent + bracket(-20.0 * middle - bend + inner, slope + outer) / 240.0
    return _exponential(exponent)


def _exponential(matrix: Float[Array, "*batch state state"]) -> Float[Array, "*batch state state"]:
    """e^M by Taylor's series of order 9 of M/16 and squaring: exact to rounding for |M| up to 3."""
    x = matrix / 16.0
    x2 = x @ x
    x3 = x2 @ x
    eye = jnp.eye(matrix.shape[-1])
    high = eye / 720 + x / 5040 + x2 / 40320 + x3 / 362880
    result = (high @ x3 + (eye / 6 + x / 24 + x2 / 120)) @ x3 + (eye + x + x2 / 2)
    for _ in range(4):
        result = result @ result
    return result


def _friction(model: Structure, coefficients: Array, frequency: Array) -> _Friction:
    """Friction along the motions.

    The period begins at the largest displacement of the first sliders' place: there every one of
    them that slips at all is being dragged, so that its position is no state of its own.
    """
    n_points, n = len(frequency), model.n_modes
    sliders = [e for e in model.hysteretic if isinstance(e, AbstractSliders)]
    others = [e for e in model.hysteretic if not isinstance(e, AbstractSliders)]
    distinct = list({effect.at: effect for effect in reversed(sliders)}.values())[::-1]
    places = elements_of(distinct, model.modes)
    nothing = jnp.zeros((n_points, n, n))
    begin = jnp.zeros_like(frequency)
    none = jnp.zeros((1, n_points, 0))
    no_sliders = none[0], _Slip(none[0] > 0, none, none)
    if not model.hysteretic:
        return _Friction(begin, nothing, (), places, np.zeros(0, int), *no_sliders)
    tau = 2 * jnp.pi * jnp.arange(_SAMPLES) / _SAMPLES
    phases = jnp.broadcast_to(tau[:, None], (_SAMPLES, n_points))
    motions = _states_at(coefficients, frequency, phases)

    def scaled(effect: AbstractHysteresis) -> tuple[AbstractHysteresis, Elements, Array]:
        """The effect as set for every point, where it is, and its displacement."""
        there = elements_of([effect], model.modes)
        x, v = (there.displacement(part)[..., 0] for part in motions)
        half_range = 0.5 * (jnp.max(x, axis=0) - jnp.min(x, axis=0))
        typical = jnp.sqrt(jnp.mean(v**2, axis=0))
        return jax.vmap(effect.scaled_for)(half_range, typical), there, x

    viscous = tuple(scaled(effect)[:2] for effect in others)
    if not sliders:
        return _Friction(begin, nothing, viscous, places, np.zeros(0, int), *no_sliders)
    largest = jnp.argmax(scaled(sliders[0])[2], axis=0)
    stiffness, slip, owner, stuck = [], [], [], nothing
    for effect in sliders:
        each, there, x = scaled(effect)
        turned = jax.vmap(lambda row, k: jnp.roll(row, -k), in_axes=(1, 0))(x, largest)
        position = jax.vmap(lambda e, x: e.settled_states(x, x))(each, turned)
        sizes = jax.vmap(lambda e: e.sliders().slip_displacement)(each)
        slip.append(jax.vmap(jax.vmap(_slip_of, (None, 1, 0)))(turned, position, sizes))
        stiffness.append(jax.vmap(lambda e: e.sliders().stiffness)(each))
        owner += [[e.at for e in distinct].index(effect.at)] * stiffness[-1].shape[1]
        stuck = stuck + there.matrix(jax.vmap(lambda e: e.added_stiffness())(each)[:, None])
    at_first, onsets, ends = (jnp.concatenate(part, axis=1) for part in zip(*slip, strict=True))
    return _Friction(
        *(tau[largest], stuck, viscous, places, np.array(owner)),
        jnp.concatenate(stiffness, axis=1),
        _Slip(at_first, jnp.moveaxis(onsets, 2, 0), jnp.moveaxis(ends, 2, 0)),
    )


def _slip_of(x: Array, position: Array, size: Array) -> tuple[Array, Array, Array]:
    """Of one slider over a period: dragged at first, phases of onsets and of ends.

    It starts where its stretch reaches the slip displacement, and stops where x turns, which a
    parabola through three samples says.
    """
    n = x.shape[0]
    width = 2 * jnp.pi / n
    ahead, behind = jnp.roll(x, -1), jnp.roll(x, 1)
    moves = position != jnp.roll(position, -1)

    def phases(starts: Array, share: Array) -> Array:
        (index,) = jnp.nonzero(starts, size=_MOST_SLIPS, fill_value=n)
        known = index < n
        there = (index + share[jnp.minimum(index, n - 1)]) * width
        return jnp.where(known, there, jnp.inf)

    rise = ahead - x
    reach = position + jnp.sign(rise) * size
    onset = jnp.clip((reach - x) / jnp.where(rise != 0, rise, 1.0), 0.0, 1.0)
    bend = 2 * x - ahead - behind
    turn = jnp.clip(0.5 * (ahead - behind) / jnp.where(bend != 0, bend, 1.0), -0.5, 0.5)
    before = jnp.roll(moves, 1)
    return before[0], phases(moves & ~before, onset), phases(before & ~moves, turn)


def _tangents(
    model: Structure, friction: _Friction, coefficients: Array, frequency: Array, tau: Array
) -> tuple[Float[Array, "time point mode mode"], Float[Array, "time point mode mode"]]:
    """K/mΩ² and C/mΩ of all points at phases τ (time,) or (time, point), stuck sliders included."""
    n_points, _, n = coefficients.shape
    terms = model.linear_terms()
    q, v = _states_at(coefficients, frequency, jnp.broadcast_to(tau.T, (n_points, len(tau))).T)
    k, c = model.slopes(q.reshape(-1, n), v.reshape(-1, n))
    k = k.reshape(*q.shape, n) + jnp.diag(terms.stiffness) + friction.stuck
    c = c.reshape(*q.shape, n) + terms.damping_matrix()
    for effect, there in friction.viscous:
        x, rate = there.displacement(q)[..., 0], there.displacement(v)[..., 0]
        c = c + there.matrix(_viscous_slope(effect, x, rate)[..., None])
    per_mass = (terms.mass * frequency[:, None])[:, :, None]
    return k / (per_mass * frequency[:, None, None]), c / per_mass


def _viscous_slope(
    effects: AbstractHysteresis, x: Float[Array, "time point"], v: Float[Array, "time point"]
) -> Float[Array, "time point"]:
    """∂f/∂ẋ of friction without memory, one effect for every point."""

    def slope(effect: AbstractHysteresis, x: Array, v: Array) -> Array:
        return jax.grad(effect.state_force, argnums=1)(x, v, effect.initial_states())

    return jax.vmap(lambda x, v: jax.vmap(slope)(effects, x, v))(x, v)


def _states_at(coefficients: Array, frequency: Array, tau: Array) -> tuple[Array, Array]:
    """q and q̇ of all points at phases τ (time, point), as (time, point, mode)."""
    orders = jnp.arange(1, (coefficients.shape[1] - 1) // 2 + 1)
    angle = tau[..., None] * orders
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    mean, a, b = coefficients[:, 0], coefficients[:, 1::2], coefficients[:, 2::2]
    q = mean + jnp.einsum("tph,phm->tpm", cosine, a) + jnp.einsum("tph,phm->tpm", sine, b)
    rate = jnp.einsum("tph,phm->tpm", cosine, orders[:, None] * b)
    rate = rate - jnp.einsum("tph,phm->tpm", sine, orders[:, None] * a)
    return q, frequency[:, None] * rate
