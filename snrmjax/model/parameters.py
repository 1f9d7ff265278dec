"""The parameters of a model by name: what can be fitted, varied or constrained."""

import dataclasses
import difflib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.attachment import unit_at
from snrmjax.model.effect_metadata import Entries
from snrmjax.model.potential import monomial_key
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import BELOW_ONE, POSITIVE, InputError, Rule

_MODE_RULES = {
    "natural_frequency": (POSITIVE,),
    "damping_ratio": (BELOW_ONE,),
    "participation": (),
}
_MODE_UNITS = {"natural_frequency": "rad/s", "damping_ratio": "1", "participation": "kg^-1/2"}
_MODE_FIELDS = tuple(_MODE_RULES)
_UNBALANCE = "unbalance_kg_m"  # the only parameter of the modes that belongs to no single mode


def parameter_names(model: Structure) -> tuple[str, ...]:
    """Names of the parameters of a model: of its potential, modes and effects.

    Names such as "potential.1111", "mode_1.natural_frequency" (rad/s), "mode_1.damping_ratio",
    "mode_1.participation" (kg^-1/2), "unbalance_kg_m" and "quadratic_damping.coefficient"; of
    several effects of a kind the second is "quadratic_damping_2". The values of a law at its knots
    are "stiffness_law.restoring_force_1" and so on; the knots themselves and other arrays are not
    parameters.

    >>> from snrmjax.model import curved_beam
    >>> parameter_names(curved_beam())[:3]
    ('potential.111', 'potential.1111', 'mode_1.natural_frequency')
    """
    return tuple(_locations(model))


def checked_names(
    model: Structure, names: Sequence[str], subject: str = "parameters"
) -> tuple[str, ...]:
    """The checked names as a tuple; `subject` is the argument's name in messages.

    Raises `ValueError` for an unknown name, with similar ones, and for a repeated one.
    """
    known = parameter_names(model)
    if isinstance(names, str) or not names:
        raise InputError(f"`{subject}` must be a sequence of names, but is {names!r}.")
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=5, cutoff=0.5) or known[:5]
            raise InputError(
                f"`{subject}` names {name!r}, which the model does not have; similar ones are "
                f"{', '.join(near)}."
            )
        if list(names).count(name) > 1:
            raise InputError(f"`{subject}` names {name!r} twice.")
    return tuple(names)


def parameter_rules(model: Structure, name: str) -> tuple[Rule, ...]:
    """Rules for the value of a parameter, as in a model file."""
    part, entry, field, _ = _locations(model)[name]
    if part == "effects":
        return model.effects[entry].parameters()[field].rules
    return (POSITIVE,) if name == _UNBALANCE else _MODE_RULES.get(field, ())


def parameter_unit(model: Structure, name: str) -> str:
    """The unit of a parameter; "1" if dimensionless."""
    part, entry, field, _ = _locations(model)[name]
    if part == "effects":
        effect = model.effects[entry]
        return unit_at(getattr(effect, "at", None), effect.parameters()[field].unit)
    if part == "potential":
        return f"J/(kg^1/2 m)^{len(model.potential.monomials[entry])}"
    return "kg m" if name == _UNBALANCE else _MODE_UNITS[field]


def parameter_value(model: Structure, name: str) -> Float[Array, ""]:
    """The value of a parameter."""
    return _number_at(model, _locations(model)[name])


def parameter_values(model: Structure) -> dict[str, float]:
    """The values of all parameters by name."""
    on_host = jax.device_get(model)  # in one transfer: one by one takes much longer
    return {
        name: float(_number_at(on_host, location)) for name, location in _locations(model).items()
    }


def stated_stds(model: Structure) -> dict[str, float]:
    """1σ of the parameters for which the model states one."""
    stds = {}
    for name, (part, entry, field, _) in _locations(model).items():
        std = getattr(getattr(model, part), f"{field}_std", None)
        if std is not None and (stated := float(np.asarray(std)[entry])) > 0:
            stds[name] = stated
    return stds


def stated_std(model: Structure, name: str) -> float:
    """1σ of a parameter in the model, 0 if not stated."""
    return stated_stds(model).get(name, 0.0)


def with_parameters(
    model: Structure, names: Sequence[str], values: Float[Array, " parameter"]
) -> Structure:
    """The model with new values of the named parameters."""
    locations = _locations(model)
    return _replaced(model, [locations[name] for name in names], values)


def with_stated_std(
    model: Structure, names: Sequence[str], std: Float[Array, " parameter"]
) -> Structure:
    """The model with new 1σ of the named parameters; those without a 1σ field are left out."""
    locations = _locations(model)
    wanted = [locations[name] for name in names]
    wanted = [location._replace(field=f"{location.field}_std") for location in wanted]
    known = [k for k, p in enumerate(wanted) if hasattr(getattr(model, p.part), p.field)]
    return _replaced(model, [wanted[k] for k in known], jnp.asarray(std)[np.array(known, int)])


class _Location(NamedTuple):
    """Location of a parameter: an entry of an array of a part, or a field of an effect."""

    part: str
    entry: int
    field: str
    knot: tuple[int, ...] = ()  # index within a field of a law


def _number_at(model: Structure, location: _Location) -> Array:
    part, entry, field, knot = location
    if part == "effects":
        return getattr(model.effects[entry], field)[knot]
    value = getattr(getattr(model, part), field)
    return value[entry] if np.ndim(value) else value


def _locations(model: Structure) -> dict[str, _Location]:
    locations = {
        f"potential.{monomial_key(monomial)}": _Location("potential", k, "coefficient")
        for k, monomial in enumerate(model.potential.monomials)
    }
    for k in range(model.n_modes):
        locations |= {
            f"mode_{k + 1}.{field}": _Location("modes", k, field) for field in _MODE_FIELDS
        }
    if model.modes.unbalance is not None:
        locations[_UNBALANCE] = _Location("modes", 0, "unbalance")
    kinds: list[str] = []
    for k, effect in enumerate(model.effects):
        kinds.append(effect.kind)
        number = kinds.count(effect.kind)
        head = effect.kind if number == 1 else f"{effect.kind}_{number}"
        for field, parameter in effect.parameters().items():
            value = getattr(effect, field)
            if jnp.ndim(value) == 0:
                locations[f"{head}.{field}"] = _Location("effects", k, field)
            elif parameter.entries is Entries.VALUES and jnp.ndim(value) == 1:
                for knot in range(value.shape[0]):
                    name = f"{head}.{field}_{knot + 1}"
                    locations[name] = _Location("effects", k, field, (knot,))
    return locations


def _replaced(
    model: Structure, locations: Sequence[_Location], values: Float[Array, " parameter"]
) -> Structure:
    effects = list(model.effects)
    entries: dict[tuple[str, str], dict[int, int]] = {}
    for k, (part, entry, field, knot) in enumerate(locations):
        if part == "effects":
            number = jnp.asarray(values[k])
            if knot:
                number = jnp.asarray(getattr(effects[entry], field)).at[knot].set(number)
            effects[entry] = dataclasses.replace(effects[entry], **{field: number})
        else:
            entries.setdefault((part, field), {})[entry] = k
    changed = {part: getattr(model, part) for part, _ in entries}
    for (part, field), numbers in entries.items():
        array = jnp.asarray(getattr(changed[part], field))
        if not array.ndim:
            changed[part] = dataclasses.replace(changed[part], **{field: values[numbers[0]]})
            continue
        # One gather: a program with a step for every entry is slow to compile and to run.
        source = np.arange(array.shape[0])
        source[list(numbers)] = array.shape[0] + np.array(list(numbers.values()))
        both = jnp.concatenate([array, jnp.asarray(values)])
        changed[part] = dataclasses.replace(changed[part], **{field: both[source]})
    return dataclasses.replace(model, effects=tuple(effects), **changed)
