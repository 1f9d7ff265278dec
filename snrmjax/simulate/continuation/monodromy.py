"""Monodromy matrices: the linearised map of a periodic motion over one period."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.effect_base import (
    AbstractForce,
    AbstractMemoryless,
    AbstractNonsmooth,
)
from snrmjax.model.effect_metadata import Argument
from snrmjax.model.elements import elements_of
from snrmjax.model.library.friction import AbstractSliders
from snrmjax.model.nonsmooth_points import crossings
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.continuation.friction_along import (
    SAMPLES,
    Friction,
    friction_along,
    states_at,
    viscous_slope,
)

_MOST_SEGMENTS = 256
_SEGMENT = 32  # steps whose propagators, or kicks, are computed as a batch
_KICKS = 3  # for every step of Magnus' method
_LEAST_KICKS = 240
_FEW_MODES = 6  # most modes with matrices multiplied term by term, points along the last axis
_FEW_SLIDERS = 16  # most sliders with steps aligned to their slip events
_GAUSS = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])


@partial(compiled, long_loops=True)
def monodromy(
    model: Structure,
    coefficients: Float[Array, "point coefficient mode"],
    frequency: Float[Array, " point"],
    steps_per_cycle: Float[Array, ""],
) -> Float[Array, "point state state"]:
    """The linearised map of (δq, δq̇ over the fastest natural frequency) over one period.

    Followed by the positions of sliders at attachment points other than the first, and by internal
    variables of friction laws. NaN where more steps would be needed than any sensible motion
    needs, and for contacts with variable normal force.
    """
    if any(len(force.influence_vectors) > 1 for force in model.forces):
        # Their slip events cannot be located between samples here.
        unknown = (frequency.shape[0], 2 * model.n_modes, 2 * model.n_modes)
        return jnp.full(unknown, jnp.nan)
    if not all(map(_is_spring, model.forces)):
        return _by_magnus(model, coefficients, frequency, steps_per_cycle)
    return _by_kicks(model, coefficients, frequency, steps_per_cycle)


def _is_spring(force: AbstractForce) -> bool:
    """Whether a force is a smooth function of the displacement, like that of a potential."""
    smooth = isinstance(force, AbstractMemoryless) and not isinstance(force, AbstractNonsmooth)
    shape = type(force).shape
    return smooth and shape is not None and shape.argument is Argument.DISPLACEMENT


def _by_kicks(
    model: Structure, coefficients: Array, frequency: Array, steps_per_cycle: Array
) -> Float[Array, "point state state"]:
    """The map for springs and a potential: oscillators with equally spaced stiffness kicks.

    Between kicks every mode moves with its own damping and mean tangent stiffness (all modes
    together if the damping couples them), which is solved exactly; the kicks apply the remaining
    varying and coupling stiffness K(t). With K − h²K²/12 in place of K the method is of order 4 up
    to a change of coordinates, which leaves the eigenvalues unchanged: the commutator [B, [A, B]]
    of the flow A and the kicks B contains K² alone, whatever the damping.
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
    coupled = model.modes.damping_coupling is not None
    mean = jnp.mean(varying, axis=0)
    linear = terms.stiffness[:, None] / per_mass[:, 0]
    rate = jnp.max(jnp.sum(jnp.abs(varying.at[:, modes, modes].add(linear)), axis=2))
    cycles = jnp.nan_to_num(jnp.sqrt(rate))
    if coupled:
        damping = terms.damping_matrix()[:, :, None] / (terms.mass[:, None, None] * frequency)
        cycles = jnp.maximum(cycles, 0.5 * jnp.max(jnp.sum(jnp.abs(damping), axis=1)))
    kicks = jnp.maximum(_KICKS * steps_per_cycle * cycles, _LEAST_KICKS)
    n_segments, step = _segments(kicks, _KICKS * _MOST_SEGMENTS)
    speed = jnp.max(terms.stiffness / terms.mass) ** 0.5 / frequency  # of δq̇, over Ω
    # The points lie along the last axis for few modes, along the first for many.
    wide = n > _FEW_MODES
    of_states = -2 if wide else 0

    def laid_out(matrix: Array) -> Array:
        return jnp.moveaxis(matrix, -1, -3) if wide else matrix

    def applied(matrix: Array, columns: Array) -> Array:
        if wide:
            return matrix @ columns
        return sum((matrix[:, j, None] * columns[j] for j in range(len(columns))), jnp.zeros(()))

    if coupled:
        flow = laid_out(_flow(mean.at[modes, modes].add(linear), damping, step, speed))
    else:
        mean = mean * np.eye(n)[:, :, None]
        damping = terms.damping[:, None] / (terms.mass[:, None] * frequency)
        own = _oscillation(linear + mean[modes, modes], damping, step, speed)
        stay, go, back, last = (laid_out(part[:, None]) for part in own)

    def kick(state: tuple, stiffness: Array) -> tuple[tuple, None]:
        q, v = state
        if coupled:
            q, v = jnp.split(applied(flow, jnp.concatenate(state, of_states)), 2, of_states)
        else:
            q, v = stay * q + go * v, back * q + last * v
        return (q, v - applied(stiffness, q)), None

    def segment(number: Array, state: tuple) -> tuple:
        tau = (number * _SEGMENT + jnp.arange(_SEGMENT) + 0.5) * step
        k = stiffness(tau) - mean
        if wide:
            square = jnp.einsum("tijp,tjkp->tikp", k, k)
        else:
            square = sum((k[:, :, j, None] * k[:, None, j] for j in range(n)), jnp.zeros(()))
        kicks = laid_out((k - step**2 / 12 * square) * (step / speed))
        return jax.lax.scan(kick, state, kicks)[0]

    eye = laid_out(jnp.broadcast_to(jnp.eye(2 * n)[:, :, None], (2 * n, 2 * n, n_points)))
    begin = tuple(jnp.split(eye, 2, of_states))
    final = jnp.concatenate(jax.lax.fori_loop(0, n_segments, segment, begin), of_states)
    return jnp.where(n_segments > 0, final if wide else jnp.moveaxis(final, 2, 0), jnp.nan)


def _segments(steps: Array, most: int) -> tuple[Array, Array]:
    """The number of segments of steps for one period, zero if too many; and the step."""
    needed = jnp.ceil(steps / _SEGMENT)
    # A motion that needs more has diverged so far that its tangents overflow anyway.
    n_segments = jnp.where(needed <= most, needed, 0).astype(int)
    return n_segments, 2 * jnp.pi / (n_segments * _SEGMENT)


def _oscillation(stiffness: Array, damping: Array, step: Array, speed: Array) -> tuple:
    """Map of (q, q̇/speed) over a step of y″ + damping y′ + stiffness y = 0, of any sign."""
    squared = stiffness - 0.25 * damping**2
    rate = jnp.sqrt(jnp.maximum(jnp.abs(squared), 1e-16))
    oscillates = squared > 0
    even = jnp.where(oscillates, jnp.cos(rate * step), jnp.cosh(rate * step))
    odd = jnp.where(oscillates, jnp.sin(rate * step), jnp.sinh(rate * step)) / rate
    decay = jnp.exp(-0.5 * damping * step)
    stay, last = even + 0.5 * damping * odd, even - 0.5 * damping * odd
    return decay * stay, decay * odd * speed, -decay * stiffness * odd / speed, decay * last


def _flow(
    stiffness: Float[Array, "mode mode point"],
    damping: Float[Array, "mode mode point"],
    step: Array,
    speed: Float[Array, " point"],
) -> Float[Array, "state state point"]:
    """The map of (q, q̇/speed) over a step: y″ + damping y′ + stiffness y = 0 of coupled modes."""
    go = jnp.eye(len(stiffness))[:, :, None] * speed
    above = jnp.concatenate([jnp.zeros_like(stiffness), go], axis=1)
    below = jnp.concatenate([-stiffness / speed, -damping], axis=1)
    generator = jnp.concatenate([above, below])
    return jnp.moveaxis(_exponential(jnp.moveaxis(generator * step, 2, 0)), 0, 2)


def _by_magnus(
    model: Structure, coefficients: Array, frequency: Array, steps_per_cycle: Array
) -> Float[Array, "point state state"]:
    """The map for forces that depend on velocity or history, in small steps.

    Magnus' method of order 6 with steps that resolve the fastest tangent frequency of all points.
    The propagators of a segment of steps are computed as a batch and then applied in sequence. A
    linear structure with sliders and stops has constant coefficients between contact and slip
    events: these intervals are then the steps, solved exactly.
    Reference: Blanes, Casas & Ros, BIT 40 (2000) 434, Eq. (3.10), doi:10.1023/A:1022311628317.
    """
    n, n_points = model.n_modes, frequency.shape[0]
    terms = model.linear_terms()
    friction = friction_along(model, coefficients, frequency)
    in_pieces = _is_piecewise_linear(model)
    contacts = _contacts(model, coefficients, frequency, friction)
    if in_pieces or 0 < friction.owner.size <= _FEW_SLIDERS:
        few = [jnp.moveaxis(part, 2, 1) for part in (friction.slip.onsets, friction.slip.ends)]
        contacts = jnp.concatenate([contacts, *(part.reshape(-1, n_points) for part in few)])
    unit = jnp.sqrt(jnp.max(terms.stiffness / terms.mass)) / frequency  # of δq̇, over Ω
    attachments, owner, n_attachments = (
        friction.attachments,
        friction.owner,
        friction.attachments.n_attachments,
    )
    own = 2 * n + sum(law.n_states for law in friction.internal)
    size = own + n_attachments
    of_attachment = np.eye(n_attachments)[owner]  # (slider, attachment)

    def generators(phase: Array, stuck: Array) -> Array:
        """The matrices A of y' = A y (time, point, state, state) at phases after the start."""
        tau = friction.begin + phase
        k, c = _tangents(model, friction, coefficients, frequency, tau)
        a = jnp.zeros((len(tau), n_points, size, size))
        if n_attachments:
            sliding_stiffness = jnp.where(stuck, 0.0, friction.stiffness) @ of_attachment
            moving = attachments.matrix(sliding_stiffness)
            k = k - moving / (terms.mass * frequency[:, None] ** 2)[..., None]
            acceleration = (
                jnp.broadcast_to(attachments.influence.T, (n, n_attachments))
                / (terms.mass[:, None])
            )
            a = a.at[:, :, n : 2 * n, own:].set(acceleration / (unit * frequency**2)[:, None, None])
        first = 2 * n
        for law in friction.internal:
            last = first + law.n_states
            by, influence = law.at(tau), law.attachment.on_modes(jnp.ones(1))
            per_force = influence[:, None] / (terms.mass * frequency[:, None] ** 2)[..., None]
            stiffer, damped = by[:, :, :1, :1] * influence, by[:, :, :1, 1:2] * influence
            k, c = k + per_force * stiffer, c + per_force * (damped * frequency[:, None, None])
            by_states = by[:, :, :1, 2:] * law.unit[:, None]
            a = a.at[:, :, n : 2 * n, first:last].set(-per_force * by_states / unit[:, None, None])
            over = law.unit[:, :, None]
            per_phase = 1 / frequency[:, None, None]
            a = a.at[:, :, first:last, :n].set(by[:, :, 1:, :1] / over * influence * per_phase)
            follows = by[:, :, 1:, 1:2] / over * influence * unit[:, None, None]
            a = a.at[:, :, first:last, n : 2 * n].set(follows)
            fades = by[:, :, 1:, 2:] / over * law.unit[:, None] * per_phase
            a = a.at[:, :, first:last, first:last].set(fades)
            first = last
        modes = np.arange(n)
        a = a.at[:, :, modes, n + modes].set(unit[:, None])
        a = a.at[:, :, n : 2 * n, :n].set(-k / unit[:, None, None])
        a = a.at[:, :, n : 2 * n, n : 2 * n].set(-c)
        return a

    def advance(state: tuple, item: tuple) -> tuple[tuple, None]:
        y, z = state
        propagator, stuck = item
        if not n_attachments:
            return (propagator @ y, z), None
        slider_force = jnp.where(stuck, friction.stiffness, 0.0)[:, :, None] * z
        force = of_attachment.T @ slider_force
        y = propagator[:, :own, :own] @ y + propagator[:, :own, own:] @ force
        return (y, jnp.where(stuck[:, :, None], z, sliding(y))), None

    def segment(number: Array, state: tuple) -> tuple:
        ends = _step_ends(number * _SEGMENT + jnp.arange(_SEGMENT + 1), step, contacts)
        stuck = ~friction.slip.slipping(0.5 * (ends[1:] + ends[:-1]))
        length = ends[1:] - ends[:-1]
        gauss = (ends[:-1, None] + length[:, None] * _GAUSS[:, None]).reshape(-1, n_points)
        a = generators(gauss, jnp.repeat(stuck, 3, axis=0))
        a = a.reshape(_SEGMENT, 3, n_points, size, size)
        return jax.lax.scan(advance, state, (_magnus(a, length[..., None, None]), stuck))[0]

    def piece(number: Array, state: tuple) -> tuple:
        begin, end = edges[number], edges[number + 1]
        middle = 0.5 * (begin + end)[None]
        stuck = ~friction.slip.slipping(middle)
        length = (end - begin)[:, None, None]
        propagator = _long_exponential(generators(middle, stuck)[0] * length)
        return advance(state, (propagator, stuck[0]))[0]

    def sliding(y: Array) -> Array:
        """The motion of every slider's attachment point."""
        local = attachments.displacement(jnp.swapaxes(y[:, :n], 1, 2))
        return jnp.swapaxes(local, 1, 2)[:, owner]

    # Sliders at the first attachment point follow its motion; the others have own positions.
    free = np.flatnonzero(owner > 0)
    y = jnp.broadcast_to(jnp.eye(own, own + free.size), (n_points, own, own + free.size))
    z = jnp.zeros((n_points, owner.size, own + free.size))
    slips = friction.slip.slips[:, :, None]
    if n_attachments:
        start = sliding(y).at[:, free].set(np.eye(own + free.size)[own:])
        z = jnp.where(slips, start, 0.0)
    if in_pieces:
        # After the last event of a motion the intervals have zero length.
        inside = jnp.where(jnp.isfinite(contacts), jnp.mod(contacts, 2 * jnp.pi), 2 * jnp.pi)
        edges = jnp.pad(jnp.sort(inside, axis=0), ((1, 0), (0, 0)))
        edges = jnp.pad(edges, ((0, 1), (0, 0)), constant_values=2 * jnp.pi)
        n_pieces = 1 + jnp.max(jnp.sum((inside < 2 * jnp.pi), axis=0))
        y, z = jax.lax.fori_loop(0, n_pieces, piece, (y, z))
        return jnp.concatenate([y, jnp.where(slips, z, 0.0)[:, free]], axis=1)
    phases = 2 * jnp.pi * jnp.arange(48)[:, None] / 48
    k, c = _tangents(model, friction, coefficients, frequency, phases)
    hidden = sum((law.stiffness() for law in friction.internal), jnp.zeros(()))
    hidden = hidden / (terms.mass * frequency[:, None] ** 2)[..., None]
    rate = jnp.sqrt(jnp.max(jnp.sum(jnp.abs(k) + jnp.abs(hidden), axis=-1)))
    cycles = jnp.nan_to_num(jnp.maximum(rate, 0.5 * jnp.max(jnp.sum(jnp.abs(c), axis=-1))))
    n_segments, step = _segments(jnp.maximum(steps_per_cycle * cycles, 512), _MOST_SEGMENTS)
    y, z = jax.lax.fori_loop(0, n_segments, segment, (y, z))
    whole = jnp.concatenate([y, jnp.where(slips, z, 0.0)[:, free]], axis=1)
    return jnp.where(n_segments > 0, whole, jnp.nan)


def _is_piecewise_linear(model: Structure) -> bool:
    """Whether a structure is linear between contact and slip events."""
    straight = all(isinstance(e, AbstractNonsmooth) and e.is_straight for e in model.memoryless)
    sliders = all(isinstance(e, AbstractSliders) for e in model.hysteretic)
    return straight and sliders and not model.potential.monomials


def _contacts(
    model: Structure, coefficients: Array, frequency: Array, friction: Friction
) -> Float[Array, "contact point"]:
    """Phases after the start at which contacts open or close, and friction laws reverse.

    Infinite if there are fewer.
    """
    tau = 2 * jnp.pi * jnp.arange(SAMPLES) / SAMPLES
    phases = friction.begin + tau[:, None]
    q, _ = states_at(coefficients, frequency, phases)
    contacts = [jnp.zeros((0, len(frequency)))]

    def add(x: Array, threshold: Array, start: Array | float = 0.0) -> None:
        crossing = jax.vmap(crossings, (1, None), 1)(x, threshold)
        phase = jnp.mod((crossing.interval + crossing.fraction) * tau[1] - start, 2 * jnp.pi)
        contacts.append(jnp.where(crossing.valid, phase, jnp.inf))

    for effect in model.memoryless:
        if isinstance(effect, AbstractNonsmooth):
            x = elements_of([effect], model.modes).displacement(q)[..., 0]
            for threshold in effect.nonsmooth_points().displacement:
                add(x, threshold)
    for law in friction.internal:
        add(law.rate, jnp.zeros(()), friction.begin)
    return jnp.concatenate(contacts)


def _step_ends(number: Array, step: Array, contacts: Array) -> Float[Array, "end point"]:
    """Phases at the ends of steps: equally spaced, the nearest to each event moved onto it.

    The stiffness then jumps within a step only where two events are closer than half a step.
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
    curvature = 10.0 / 3.0 * (last - 2 * middle + first)
    inner = bracket(middle, slope)
    outer = -bracket(middle, 2 * curvature + inner) / 60.0
    exponent = middle + curvature / 12.0
    exponent = exponent + bracket(-20.0 * middle - curvature + inner, slope + outer) / 240.0
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


def _long_exponential(matrix: Float[Array, "point state state"]) -> Array:
    """e^M of any norm: that of M/2^k, squared k times."""
    norm = jnp.nan_to_num(jnp.max(jnp.sum(jnp.abs(matrix), axis=-1)), posinf=0.0)
    doublings = jnp.ceil(jnp.log2(jnp.maximum(norm, 1.0))).astype(int)
    short = _exponential(matrix * 0.5**doublings)
    return jax.lax.fori_loop(0, doublings, lambda _, power: power @ power, short)


def _tangents(
    model: Structure, friction: Friction, coefficients: Array, frequency: Array, tau: Array
) -> tuple[Float[Array, "time point mode mode"], Float[Array, "time point mode mode"]]:
    """K/mΩ² and C/mΩ of all points at phases τ (time,) or (time, point), stuck sliders included."""
    n_points, _, n = coefficients.shape
    terms = model.linear_terms()
    q, v = states_at(coefficients, frequency, jnp.broadcast_to(tau.T, (n_points, len(tau))).T)
    k, c = model.slopes(q.reshape(-1, n), v.reshape(-1, n))
    k = k.reshape(*q.shape, n) + jnp.diag(terms.stiffness) + friction.stuck
    c = c.reshape(*q.shape, n) + terms.damping_matrix()
    for effect, attachment in friction.viscous:
        x, rate = attachment.displacement(q)[..., 0], attachment.displacement(v)[..., 0]
        c = c + attachment.matrix(viscous_slope(effect, x, rate)[..., None])
    per_mass = (terms.mass * frequency[:, None])[:, :, None]
    return k / (per_mass * frequency[:, None, None]), c / per_mass
