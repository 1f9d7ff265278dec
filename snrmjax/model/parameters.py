"""The numbers of a model by name: what can be fitted, varied or held near a stated value."""

import dataclasses
import difflib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.effect_metadata import Entries
from snrmjax.model.places import unit_at
from snrmjax.model.potential import monomial_key
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import BELOW_ONE, POSITIVE, Rule

_MODE_RULES = {
    "natural_frequency": (POSITIVE,),
    "damping_ratio": (BELOW_ONE,),
    "participation": (),
}
_MODE_UNITS = {"natural_frequency": "rad/s", "damping_ratio": "1", "participation": "kg^-1/2"}
_MODE_FIELDS = tuple(_MODE_RULES)
_UNBALANCE = "unbalance_kg_m"  # the name of the one number of modes that is of no mode


def parameter_names(model: Structure) -> tuple[str, ...]:
    """Names of the numbers of a model: of its potential, its modes and its effects.

    Names such as "potential.1111", "mode_1.natural_frequency" (rad/s), "mode_1.damping_ratio",
    "mode_1.participation" (kg^-1/2), "unbalance_kg_m" and "quadratic_damping.coefficient"; of
    several effects of a kind the second is "quadratic_damping_2". The values of a law at its knots
    are "stiffness_law.restoring_force_1" and so on; the knots themselves are no parameters, nor are
    other arrays.

    >>> from snrmjax.model import curved_beam
    >>> parameter_names(curved_beam())[:3]
    ('potential.111', 'potential.1111', 'mode_1.natural_frequency')
    """
    return tuple(_places(model))


def checked_names(
    model: Structure, names: Sequence[str], subject: str = "parameters"
) -> tuple[str, ...]:
    """The names as a tuple, checked; `subject` is the argument that has them.

    Raises `ValueError` for an unknown name, with similar ones, and for one that is given twice.
    """
    known = parameter_names(model)
    if isinstance(names, str) or not names:
        raise ValueError(f"`{subject}` must be a sequence of names, but is {names!r}.")
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=5, cutoff=0.5) or known[:5]
            raise ValueError(
                f"`{subject}` names {name!r}, which the model does not have; similar ones are "
                f"{', '.join(near)}."
            )
        if list(names).count(name) > 1:
            raise ValueError(f"`{subject}` names {name!r} twice.")
    return tuple(names)


def parameter_rules(model: Structure, name: str) -> tuple[Rule, ...]:
    """What the number that a name of `parameter_names` stands for must be, as in a model file."""
    part, entry, field, _ = _places(model)[name]
    if part == "effects":
        return model.effects[entry].parameters()[field].rules
    return (POSITIVE,) if name == _UNBALANCE else _MODE_RULES.get(field, ())


def parameter_unit(model: Structure, name: str) -> str:
    """The unit of the number that a name of `parameter_names` stands for; "1" for none."""
    part, entry, field, _ = _places(model)[name]
    if part == "effects":
        effect = model.effects[entry]
        return unit_at(getattr(effect, "at", None), effect.parameters()[field].unit)
    if part == "potential":
        return f"J/(kg^1/2 m)^{len(model.potential.monomials[entry])}"
    return "kg m" if name == _UNBALANCE else _MODE_UNITS[field]


def parameter_value(model: Structure, name: str) -> Float[Array, ""]:
    """The number that a name of `parameter_names` stands for."""
    return _number_at(model, _places(model)[name])


def parameter_values(model: Structure) -> dict[str, float]:
    """All numbers by their names."""
    on_host = jax.device_get(model)  # all at once: one by one they take much longer
    return {name: float(_number_at(on_host, place)) for name, place in _places(model).items()}


def stated_stds(model: Structure) -> dict[str, float]:
    """1σ of the numbers for which the model states one."""
    stds = {}
    for name, (part, entry, field, _) in _places(model).items():
        std = getattr(getattr(model, part), f"{field}_std", None)
        if std is not None and (stated := float(np.asarray(std)[entry])) > 0:
            stds[name] = stated
    return stds


def stated_std(model: Structure, name: str) -> float:
    """1σ that the model states for a number, 0 where it states none."""
    return stated_stds(model).get(name, 0.0)


def with_parameters(
    model: Structure, names: Sequence[str], values: Float[Array, " parameter"]
) -> Structure:
    """The model with other numbers under some names."""
    places = _places(model)
    return _replaced(model, [places[name] for name in names], values)


def with_stated_std(
    model: Structure, names: Sequence[str], std: Float[Array, " parameter"]
) -> Structure:
    """The model with other 1σ of named numbers; those that have no 1σ in a model are left out."""
    places = _places(model)
    wanted = [places[name] for name in names]
    wanted = [place._replace(field=f"{place.field}_std") for place in wanted]
    known = [k for k, p in enumerate(wanted) if hasattr(getattr(model, p.part), p.field)]
    return _replaced(model, [wanted[k] for k in known], jnp.asarray(std)[np.array(known, int)])


class _Place(NamedTuple):
    """Where a number is: an entry of an array of a part, or a field of an effect."""

    part: str
    entry: int
    field: str
    knot: tuple[int, ...] = ()  # of a law's field the place in it


def _number_at(model: Structure, place: _Place) -> Array:
    part, entry, field, knot = place
    if part == "effects":
        return getattr(model.effects[entry], field)[knot]
    value = getattr(getattr(model, part), field)
    return value[entry] if np.ndim(value) else value


def _places(model: Structure) -> dict[str, _Place]:
    places = {
        f"potential.{monomial_key(monomial)}": _Place("potential", k, "coefficient")
        for k, monomial in enumerate(model.potential.monomials)
    }
    for k in range(model.n_modes):
        places |= {f"mode_{k + 1}.{field}": _Place("modes", k, field) for field in _MODE_FIELDS}
    if model.modes.unbalance is not None:
        places[_UNBALANCE] = _Place("modes", 0, "unbalance")
    kinds: list[str] = []
    for k, effect in enumerate(model.effects):
        kinds.append(effect.kind)
        number = kinds.count(effect.kind)
        head = effect.kind if number == 1 else f"{effect.kind}_{number}"
        for field, parameter in effect.parameters().items():
            value = getattr(effect, field)
            if jnp.ndim(value) == 0:
                places[f"{head}.{field}"] = _Place("effects", k, field)
            elif parameter.entries is Entries.VALUES and jnp.ndim(value) == 1:
                for knot in range(value.shape[0]):
                    name = f"{head}.{field}_{knot + 1}"
                    places[name] = _Place("effects", k, field, (knot,))
    return places


def _replaced(
    model: Structure, places: Sequence[_Place], values: Float[Array, " place"]
) -> Structure:
    effects = list(model.effects)
    entries: dict[tuple[str, str], dict[int, int]] = {}
    for k, (part, entry, field, knot) in enumerate(places):
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
        # All at once: a program with a step for every entry is slow to compile and to run.
        source = np.arange(array.shape[0])
        source[list(numbers)] = array.shape[0] + np.array(list(numbers.values()))
        both = jnp.concatenate([array, jnp.asarray(values)])
        changed[part] = dataclasses.replace(changed[part], **{field: both[source]})
    return dataclasses.replace(model, effects=tuple(effects), **changed)
