"""Peaks, folds and phase resonances of a forced response as functions of uncertain inputs."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.model.parameters import checked_names
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_blocks, mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.labelled import HERTZ
from snrmjax.simulate.continuation.response_curve import ResponseCurve
from snrmjax.simulate.solutions.forced_response import (
    ResponseSettings,
    forced_response_batch,
)
from snrmjax.simulate.solutions.periodic_motion import PeriodicMotion, periodic_motion, turning
from snrmjax.study.uncertainty.made_models import (
    Base,
    MadeModels,
    ModelOf,
    made_models,
    with_numbers,
)
from snrmjax.study.uncertainty.quantities import (
    AbstractQuantities,
    Expansion,
    MemberStatus,
    SolvedMembers,
)
from snrmjax.study.uncertainty.uncertain_inputs import FORCE, UncertainInputs

EventKind = Literal["peak", "fold", "phase_resonance"]
_BLOCK = 32  # members that one call works on
_SMALLEST = 1 / 512  # share of the way to a member below which a motion counts as ceased
_STEPS = 60  # on the way to a member, at most
_ITERATIONS = 12  # of Newton's method, which starts from a prediction
_LATE = 0.1  # correction over step, beyond which the step was too long
_NEAR = 0.002  # of the motion: a correction that is never too large


class NominalMotion(NamedTuple):
    """One peak, fold or phase resonance at the nominal inputs, and its derivatives by z."""

    coefficients: Float[Array, "coefficient mode"]  # kg^1/2 m
    frequency: Float[Array, ""]  # rad/s
    coefficients_by_z: Float[Array, "coefficient mode input"]
    frequency_by_z: Float[Array, " input"]
    turning: Float[Array, ""]  # which way the curve turns there


class ResponseQuantities(AbstractQuantities):
    """Frequency and velocity of events of one response curve, by uncertain inputs.

    Make it with `response_quantities`. The events are those of the nominal curve; at other inputs
    each is the motion that it becomes as the inputs change on a straight line in z.
    """

    base: Base
    inputs: UncertainInputs
    motions: tuple[NominalMotion, ...]
    curves: tuple[ResponseCurve, ...]  # nominal
    ends: Float[np.ndarray, " end"]  # rad/s
    kinds: tuple[EventKind, ...] = eqx.field(static=True)  # one a motion
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)
    made: MadeModels | None = None  # of inputs that are no numbers of the model

    def expansion(self) -> Expansion:
        """See `AbstractQuantities`."""
        parts = [
            [np.asarray(part) for part in _expanded(self.base, self.inputs, kind, motion)]
            for kind, motion in zip(self.kinds, self.motions, strict=True)
        ]
        return Expansion(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def members(self, z: Float[np.ndarray, "member input"]) -> SolvedMembers:
        """See `AbstractQuantities`; what cannot be followed is looked for on the whole curve."""
        followed = self._followed(z)
        ceased = followed.status == int(MemberStatus.CEASED)
        rows = np.flatnonzero(ceased.any(axis=1))
        if not rows.size:
            return followed
        values, status = followed.values.copy(), followed.status.copy()
        whole, _ = self.traced(np.asarray(z)[rows])
        instead = ceased[rows] & np.isfinite(whole)
        values[rows] = np.where(instead, whole, values[rows])
        status[rows] = np.where(instead, int(MemberStatus.REPLACED), status[rows])
        return SolvedMembers(values, status)

    def traced(
        self, z: Float[np.ndarray, "member input"]
    ) -> tuple[Float[np.ndarray, "member quantity"], Bool[np.ndarray, " member"]]:
        """The same quantities read from every member's whole response curve, and which are traced.

        The highest peak, the strongest phase resonance and the folds in order along the curve: NaN
        where a curve has none, and, of folds, where it has not as many as the nominal one.
        """
        rows = np.asarray(z, dtype=np.float64)
        models, forces = [], []
        numbers = np.zeros((len(rows), 0)) if self.made is None else self.made.numbers(rows)
        for row, own in zip(rows, numbers, strict=True):
            model, force = self.base.at(self.inputs, jnp.asarray(row))
            models.append(model if self.made is None else with_numbers(model, own))
            forces.append(float(force))
        order = (self.motions[0].coefficients.shape[0] - 1) // 2
        settings = ResponseSettings(harmonic_order=order, stability=False)
        batch = forced_response_batch(models, forces, *self.ends.tolist(), settings=settings)
        found = np.full((len(rows), len(self.names)), np.nan)
        for row, curves in zip(found, batch.curves, strict=True):
            for kind in dict.fromkeys(self.kinds):
                places = [2 * k for k, own in enumerate(self.kinds) if own == kind]
                events = _events(curves, kind)
                if len(events) == len(places):
                    for place, (curve, k) in zip(places, events, strict=True):
                        speed = np.abs(curve.velocity[k, 1, 0])
                        row[place : place + 2] = curve.frequency[k] / HERTZ, speed
        return found, batch.n_points > 0

    def _followed(self, z: np.ndarray) -> SolvedMembers:
        rows = np.asarray(z, dtype=np.float64)
        possible = self.inputs.possible(rows)
        safe = np.where(possible[:, None], rows, 0.0)
        rest = np.zeros((len(safe), 0)) if self.made is None else self.made.rest(safe)
        values = []
        for kind, motion in zip(self.kinds, self.motions, strict=True):

            def block(
                some: np.ndarray,
                rest: np.ndarray,
                kind: EventKind = kind,
                motion: NominalMotion = motion,
            ) -> tuple:
                return (_follow(self.base, self.inputs, kind, motion, some, rest),)

            values += by_blocks(block, _BLOCK, safe, rest)
        table = np.where(possible[:, None], np.concatenate(values, axis=1), np.nan)
        ceased = np.where(np.isnan(table), int(MemberStatus.CEASED), int(MemberStatus.FOUND))
        status = np.where(possible[:, None], ceased, int(MemberStatus.IMPOSSIBLE))
        return SolvedMembers(table, status)


def response_quantities(
    model: Structure,
    inputs: UncertainInputs,
    from_frequency: float,
    to_frequency: float,
    *,
    force: float | None = None,
    kinds: Sequence[EventKind] = ("peak", "fold", "phase_resonance"),
    harmonic_order: int = 9,
    model_of: ModelOf | None = None,
) -> ResponseQuantities:
    """Frequency (Hz) and velocity (m/s) of a response's events as functions of uncertain inputs.

    The response at the nominal inputs is traced once. Of it are taken the highest peak of the
    velocity fundamental at the first sensor, every fold in order along the curve and the strongest
    phase resonance. At other inputs each solves the harmonic balance with its condition (see
    `periodic_motion`), started by prediction from the nominal motion and its derivatives;
    where that jumps or fails, in shorter steps of the inputs. A step that ends on another
    fold or on a minimum is refused.

    Arguments: frequencies in rad/s, the range of the nominal response; `force` in N, unless it is
    among `inputs`; `model_of`, a differentiable JAX function that makes the model of the inputs'
    values by name, where inputs are no parameters of `model` (dimensions, say). It is
    differentiated once, at the nominal inputs, and called once for every member.
    Returns `ResponseQuantities`; kinds of which the nominal curve has none are in its `notes`.
    Raises `ValueError` for unknown names or kinds, a force that is missing or given twice, and
    where the nominal curve has none of the events.
    Members whose motion ceases on the way are looked for on their whole response curves, and have
    a status that says which.
    Validity: a motion is followed by its own branch; that another peak becomes the highest is seen
    by `ResponseQuantities.traced` only, which `propagate_uncertainty` uses on some members.

    >>> from snrmjax.model import flat_beam
    >>> from snrmjax.study.uncertainty.uncertain_inputs import uncertain_inputs
    >>> beam = flat_beam()
    >>> inputs = uncertain_inputs(beam, {"mode_1.damping_ratio": 0.005})
    >>> found = response_quantities(beam, inputs, 480.0, 520.0, force=2e-4, harmonic_order=1)
    >>> found.names[:2]
    ('peak_frequency_hz', 'peak_velocity_m_s')
    """
    for kind in kinds:
        if kind not in get_args(EventKind):
            raise ValueError(f"`kinds` must be out of {get_args(EventKind)}, but has {kind!r}.")
    checked = [name for name in inputs.names if name != FORCE]
    if checked and model_of is None:
        checked_names(model, checked)
    if (force is None) != (FORCE in inputs.names):
        verb = "are given none of" if force is None else "have"
        raise ValueError(f"`force` must be given once, but it is {force!r} and inputs {verb} it.")
    load = np.asarray(1.0 if force is None else force, dtype=np.float64)
    made = None if model_of is None else made_models(model_of, inputs)
    base = Base(model, load, None if made is None else made.series)
    nominal, nominal_force = base.at(inputs, jnp.zeros(len(inputs.names)))
    settings = ResponseSettings(harmonic_order=harmonic_order, stability=False)
    ends = np.array([from_frequency, to_frequency], dtype=np.float64)
    (curves,) = forced_response_batch(
        nominal, float(nominal_force), *ends.tolist(), settings=settings
    ).curves
    found = {kind: _events(curves, kind) for kind in dict.fromkeys(kinds)}
    motions, own, names, lost = [], [], [], []
    for kind, events in found.items():
        for number, (curve, k) in enumerate(events):
            name = _name(kind, number)
            motion, converged = _nominal(base, inputs, kind, curve.point(k))
            if not bool(converged):
                lost.append(name)
                continue
            motions.append(motion)
            own.append(kind)
            names += [f"{name}_frequency_hz", f"{name}_velocity_m_s"]
    notes = [
        f"the nominal response has no {kind.replace('_', ' ')} from {ends[0] / HERTZ:.5g} to"
        f" {ends[1] / HERTZ:.5g} Hz"
        for kind, events in found.items()
        if not events
    ]
    notes += [f"{name} was not found again from the curve and is left out" for name in lost]
    if not motions:
        raise ValueError(f"nothing to propagate to: {'; '.join(notes) or 'no kinds'}.")
    units = ("Hz", "m/s") * len(motions)
    return ResponseQuantities(
        base=base,
        inputs=inputs,
        motions=tuple(motions),
        curves=curves,
        ends=ends,
        kinds=tuple(own),
        names=tuple(names),
        units=units,
        notes=tuple(notes),
        made=made,
    )


def _name(kind: EventKind, number: int) -> str:
    return {"peak": "peak", "phase_resonance": "resonance", "fold": f"fold_{number + 1}"}[kind]


def _events(curves: Sequence[ResponseCurve], kind: EventKind) -> list[tuple[ResponseCurve, int]]:
    """Where the events are: folds in order, of others the one with the largest velocity."""
    every = [(curve, int(k)) for curve in curves for k in curve.at_events(kind)]
    if kind == "fold" or not every:
        return every
    return [max(every, key=lambda at: float(np.abs(at[0].velocity[at[1], 1, 0])))]


def _motion(
    base: Base, inputs: UncertainInputs, kind: EventKind, start: tuple, z: Array
) -> PeriodicMotion:
    model, force = base.at(inputs, z)
    return periodic_motion(model, force, start, condition=kind, iterations=_ITERATIONS)


def _pair(motion: PeriodicMotion) -> Float[Array, " 2"]:
    return jnp.stack([motion.frequency / HERTZ, motion.amplitude])


@compiled
def _nominal(
    base: Base, inputs: UncertainInputs, kind: EventKind, start: tuple
) -> tuple[NominalMotion, Array]:
    zero = jnp.zeros(len(inputs.names))

    def found(z: Array) -> tuple[tuple[Array, Array], PeriodicMotion]:
        motion = _motion(base, inputs, kind, start, z)
        return (motion.coefficients, motion.frequency), motion

    slopes, motion = jax.jacfwd(found, has_aux=True)(zero)
    turn = turning(*base.at(inputs, zero), motion, kind)
    nominal = NominalMotion(motion.coefficients, motion.frequency, slopes[0], slopes[1], turn)
    return nominal, motion.converged


@compiled
def _expanded(
    base: Base, inputs: UncertainInputs, kind: EventKind, near: NominalMotion
) -> tuple[Array, Array, Array]:
    def pair(z: Array) -> Array:
        return _pair(_motion(base, inputs, kind, near[:2], z))

    zero, slopes = jnp.zeros(len(inputs.names)), jax.jacfwd(pair)
    return pair(zero), slopes(zero), jax.jacfwd(slopes)(zero)


class _Way(NamedTuple):
    """How far a motion is followed from the nominal inputs (0) to a member's (1)."""

    share: Array
    step: Array
    n_steps: Array
    point: tuple[Array, Array]  # coefficients and frequency
    slope: tuple[Array, Array]  # of them by the share, where it is known
    known: Array
    share_before: Array  # at the last point
    slope_before: tuple[Array, Array]


@compiled
def _follow(
    base: Base,
    inputs: UncertainInputs,
    kind: EventKind,
    near: NominalMotion,
    z: Array,
    rests: Array,
) -> Array:
    """Frequency (Hz) and velocity of every member.

    `rests` are the numbers of every member's model less those of the series.
    """
    size, speed = jnp.max(jnp.abs(near.coefficients)), near.frequency

    def member(row: Array, rest: Array) -> Array:
        def apart(one: tuple, other: tuple) -> Array:
            moved = jnp.max(jnp.abs(one[0] - other[0])) / size
            return jnp.maximum(moved, jnp.abs(one[1] - other[1]) / speed)

        def slope(way: _Way) -> tuple[Array, Array]:
            def along(share: Array) -> tuple[Array, Array]:
                own = base.toward(rest, share)
                motion = _motion(own, inputs, kind, way.point, share * row)
                return motion.coefficients, motion.frequency

            def computed() -> tuple[Array, Array]:
                return jax.jvp(along, (way.share,), (jnp.ones(()),))[1]

            return jax.lax.cond(way.known, lambda: way.slope, computed)

        def body(way: _Way) -> _Way:
            here, ahead = way.point, slope(way)
            step = jnp.minimum(way.step, 1 - way.share)
            width = way.share - way.share_before
            bend = jnp.where(width > 0, 0.5 * step**2 / jnp.where(width > 0, width, 1.0), 0.0)
            guess = jax.tree.map(
                lambda x, s, last: x + step * s + bend * (s - last), here, ahead, way.slope_before
            )
            to = way.share + step
            own = base.toward(rest, to)
            motion = _motion(own, inputs, kind, guess, to * row)
            there = (motion.coefficients, motion.frequency)
            turn = turning(*own.at(inputs, to * row), motion, kind)
            close = apart(there, guess) <= _LATE * apart(guess, here) + _NEAR
            good = motion.converged & close & (turn * near.turning > 0)

            def chosen(yes: Any, no: Any) -> Any:
                return jax.tree.map(lambda a, b: jnp.where(good, a, b), yes, no)

            return _Way(
                share=jnp.where(good, to, way.share),
                step=jnp.where(good, 2 * step, step / 4),
                n_steps=way.n_steps + 1,
                point=chosen(there, here),
                slope=ahead,
                known=~good,
                share_before=jnp.where(good, way.share, way.share_before),
                slope_before=chosen(ahead, way.slope_before),
            )

        def going(way: _Way) -> Array:
            return (way.share < 1) & (way.step > _SMALLEST) & (way.n_steps < _STEPS)

        first = (near.coefficients_by_z @ row, near.frequency_by_z @ row)
        begin = _Way(
            share=jnp.zeros(()),
            step=jnp.ones(()),
            n_steps=jnp.array(0),
            point=(near.coefficients, near.frequency),
            slope=first,
            known=jnp.array(True),
            share_before=jnp.zeros(()),
            slope_before=first,
        )
        end = jax.lax.while_loop(going, body, begin)
        arrived = end.share >= 1
        start = (jnp.where(arrived, end.point[0], jnp.nan), end.point[1])
        arrived_at = base.toward(rest, jnp.ones(()))
        return _pair(_motion(arrived_at, inputs, kind, start, row))

    return mapped(member, z, rests)
