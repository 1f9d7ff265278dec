"""Quantities of uncertain inputs with gradient and Hessian: response events or any function."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from snrmjax.model.parameters import checked_names, with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.continuation.response_curve import ResponseCurve
from snrmjax.simulate.solutions.forced_response import ResponseSettings, forced_response_batch
from snrmjax.simulate.solutions.periodic_motion import periodic_motion
from snrmjax.study.variations import AbstractVariation

FORCE = "force_n"
EventKind = Literal["peak", "fold", "phase_resonance"]
ModelOf = Callable[[dict[str, Array]], Structure]


class Quantities(eqx.Module):
    """Named quantities with derivatives over the standard normal numbers z of the inputs, at z = 0.

    Every input has its median at z = 0, which for a lognormal one is below its mean.
    """

    value: Float[np.ndarray, " quantity"] = eqx.field(converter=np.asarray)
    gradient: Float[np.ndarray, "quantity input"] = eqx.field(converter=np.asarray)
    hessian: Float[np.ndarray, "quantity input input"] = eqx.field(converter=np.asarray)
    names: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[Fact, ...] = eqx.field(static=True, default=())


def function_quantities(
    function: Callable[[Float[Array, " input"]], Float[Array, " quantity"]],
    varied: Sequence[AbstractVariation],
    names: Sequence[str],
) -> Quantities:
    """The results of a JAX function of the vector of uncertain inputs.

    >>> from snrmjax.study.variations import Normal
    >>> varied = Normal("a", 1.0, 0.1), Normal("b", 2.0, 0.2)
    >>> area = function_quantities(lambda x: x[:1] * x[1], varied, ["area_m2"])
    >>> area.gradient.round(12).tolist()
    [[0.2, 0.2]]
    """
    value, gradient, hessian = map(np.asarray, _of_function(function, tuple(varied)))
    return Quantities(value, gradient, hessian, tuple(names))


@on_numbers(
    "Its result holds the derivatives; in a program of your own differentiate "
    "`sj.simulate.periodic_motion`."
)
def response_quantities(
    model: Structure,
    varied: Sequence[AbstractVariation],
    from_frequency: float,
    to_frequency: float,
    *,
    force: float | None = None,
    kinds: Sequence[EventKind] = ("peak", "fold", "phase_resonance"),
    harmonic_order: int = 9,
    model_of: ModelOf | None = None,
) -> Quantities:
    """Frequency (Hz) and velocity (m/s) of a response's events over uncertain inputs.

    The response at their medians is computed once. Its events are the highest peak of the velocity
    fundamental at the first sensor, every fold in order along the curve and the strongest phase
    resonance. Each solves the harmonic balance with its condition (see `periodic_motion`), whose
    first and second derivatives follow from the implicit function theorem.

    Arguments: `varied` as in a `Study`, by the names of `snrmjax.model.parameter_names` and
    "force_n"; frequencies in rad/s, the range of the nominal response; `force` in N, unless it is
    uncertain; `model_of`, a differentiable JAX function that makes the model from the inputs by
    name, where they are not parameters of `model` (such as dimensions).
    Returns `Quantities`; its `notes` name kinds without an event on the nominal curve.
    Raises `ValueError` for unknown names or kinds, a force that is missing or given twice, and
    where the nominal curve has none of the events.
    Validity: derivatives are local to the medians and do not include folds that merge or another
    peak that becomes the highest; a `Study` of the same `varied` does.

    >>> from snrmjax.model import flat_beam
    >>> from snrmjax.study.variations import Normal
    >>> beam, varied = flat_beam(), [Normal("mode_1.damping_ratio", 0.05, 0.005)]
    >>> settings = {"force": 2e-4, "kinds": ["peak"], "harmonic_order": 1}
    >>> found = response_quantities(beam, varied, 480.0, 520.0, **settings)
    >>> found.names
    ('peak_frequency_hz', 'peak_velocity_m_s')
    """
    for kind in kinds:
        if kind not in get_args(EventKind):
            raise InputError(f"`kinds` must be out of {get_args(EventKind)}, but has {kind!r}.")
    inputs = _Inputs(tuple(varied))
    for name in inputs.names:
        if inputs.names.count(name) > 1:
            raise InputError(f"{name} varies twice.")
    checked = [name for name in inputs.names if name != FORCE]
    if checked and model_of is None:
        checked_names(model, checked)
    if (force is None) != (FORCE in inputs.names):
        verb = "do not have" if force is None else "have"
        raise InputError(f"`force` must be given once, but it is {force!r} and `varied` {verb} it.")
    load = np.asarray(1.0 if force is None else force, dtype=np.float64)
    nominal = _Nominal(model, load, None if model_of is None else _series(model_of, inputs))
    settings = ResponseSettings(harmonic_order=harmonic_order, stability=False)
    middle, middle_force = nominal.at(inputs, jnp.zeros(len(inputs.names)))
    (curves,) = forced_response_batch(
        middle, float(middle_force), from_frequency, to_frequency, settings=settings
    ).curves
    parts: list[list] = []
    names: list[str] = []
    notes: list[Fact] = []
    for kind in dict.fromkeys(kinds):
        events = _events(curves, kind)
        if not events:
            ends = {"low_hz": from_frequency / HERTZ, "high_hz": to_frequency / HERTZ}
            notes.append(Fact("no_event_in_response", event=kind, **ends))
        for number, (curve, k) in enumerate(events, 1):
            name = {"phase_resonance": "resonance", "fold": f"fold_{number}"}.get(kind, kind)
            *part, converged = _of_event(nominal, inputs, kind, curve.point(k))
            if not bool(converged):
                notes.append(Fact("event_not_found_again", event=name))
                continue
            parts.append(part)
            names += [f"{name}_frequency_hz", f"{name}_velocity_m_s"]
    if not parts:
        raise InputError(f"nothing to propagate to: {'; '.join(map(str, notes)) or 'no kinds'}.")
    value, gradient, hessian = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Quantities(value, gradient, hessian, tuple(names), tuple(notes))


def _events(curves: Sequence[ResponseCurve], kind: EventKind) -> list[tuple[ResponseCurve, int]]:
    """Events of one kind: all folds in order, else the one with the largest velocity."""
    events = [(curve, int(k)) for curve in curves for k in curve.at_events(kind)]
    if kind == "fold" or not events:
        return events
    return [max(events, key=lambda at: float(np.abs(at[0].velocity[at[1], 1, 0])))]


class _Inputs(NamedTuple):
    """Uncertain inputs as functions of standard normal numbers."""

    varied: tuple[AbstractVariation, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for one in self.varied for name in one.names)

    def values(self, z: Float[Array, " input"]) -> Float[Array, " input"]:
        parts = jnp.split(z, np.cumsum([len(one.names) for one in self.varied])[:-1])
        each = zip(self.varied, parts, strict=True)
        return jnp.concatenate([one.at(part) for one, part in each])

    def by_name(self, z: Float[Array, " input"]) -> dict[str, Array]:
        return dict(zip(self.names, self.values(z), strict=True))


class _Series(NamedTuple):
    """A model whose numbers are a quadratic in z, sufficient for two derivatives at z = 0.

    The condensation of a beam has many steps, which would otherwise be compiled into the program
    of every kind of event.
    """

    template: Structure
    numbers: Float[Array, " number"]
    slopes: Float[Array, "number input"]
    curvature: Float[Array, "number input input"]

    def model(self, z: Float[Array, " input"]) -> Structure:
        """The model at z."""
        quadratic = jnp.einsum("nij,i,j->n", self.curvature, z, z)
        numbers = self.numbers + self.slopes @ z + 0.5 * quadratic
        arrays, others = eqx.partition(self.template, _is_number)
        return eqx.combine(ravel_pytree(arrays)[1](numbers), others)


class _Nominal(NamedTuple):
    """Model and force as functions of z."""

    model: Structure
    force: Float[np.ndarray, ""]  # N, where it is not uncertain
    series: _Series | None  # for inputs that are not parameters of the model

    def at(self, inputs: _Inputs, z: Float[Array, " input"]) -> tuple[Structure, Float[Array, ""]]:
        """Model and force at standard normal numbers."""
        values, model = inputs.values(z), self.model
        of_model = [k for k, name in enumerate(inputs.names) if name != FORCE]
        if self.series is not None:
            model = self.series.model(z)
        elif of_model:
            names = [inputs.names[k] for k in of_model]
            model = with_parameters(model, names, values[np.array(of_model)])
        if FORCE in inputs.names:
            return model, values[inputs.names.index(FORCE)]
        return model, jnp.asarray(self.force)


def _series(model_of: ModelOf, inputs: _Inputs) -> _Series:
    zero = jnp.zeros(len(inputs.names))
    return _Series(model_of(inputs.by_name(zero)), *_of_model(model_of, inputs))


def _is_number(leaf: object) -> bool:
    return isinstance(leaf, float) or eqx.is_inexact_array(leaf)


def _derivatives(
    function: Callable[[Array], tuple[Array, Any]], inputs: _Inputs
) -> tuple[Any, ...]:
    """Value, gradient and Hessian at z = 0 of the first result, then the second result."""

    def value(z: Array) -> tuple[Array, tuple[Array, Any]]:
        first, rest = function(z)
        return first, (first, rest)

    def slopes(z: Array) -> tuple[Array, tuple]:
        gradient, (first, rest) = jax.jacfwd(value, has_aux=True)(z)
        return gradient, (first, gradient, rest)

    hessian, (first, gradient, rest) = jax.jacfwd(slopes, has_aux=True)(
        jnp.zeros(len(inputs.names))
    )
    return first, gradient, hessian, rest


@compiled
def _of_function(
    function: Callable[[Array], Array], varied: tuple[AbstractVariation, ...]
) -> tuple[Array, ...]:
    inputs = _Inputs(varied)
    return _derivatives(lambda z: (function(inputs.values(z)), None), inputs)[:3]


@compiled
def _of_model(model_of: ModelOf, inputs: _Inputs) -> tuple[Array, ...]:
    def numbers(z: Array) -> tuple[Array, None]:
        return ravel_pytree(eqx.filter(model_of(inputs.by_name(z)), _is_number))[0], None

    return _derivatives(numbers, inputs)[:3]


@compiled
def _of_event(
    nominal: _Nominal, inputs: _Inputs, kind: EventKind, start: tuple
) -> tuple[Array, ...]:
    """Frequency (Hz) and velocity with derivatives, and whether the motion converged."""

    def pair(z: Array) -> tuple[Array, Array]:
        model, force = nominal.at(inputs, z)
        motion = periodic_motion(model, force, start, condition=kind)
        return jnp.stack([motion.frequency / HERTZ, motion.amplitude]), motion.converged

    return _derivatives(pair, inputs)
