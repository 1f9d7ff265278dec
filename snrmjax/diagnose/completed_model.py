"""The model with the effects that were found, if a structure can have such parameters."""

import dataclasses
from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.model.effects import effect_parameters, make_effect
from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import BELOW_ONE, NOT_ZERO, POSITIVE, Rule

_RULES: Mapping[str, Rule] = {
    "natural_frequency": POSITIVE,
    "damping_ratio": BELOW_ONE,
    "participation": NOT_ZERO,
}


class CompletedStatus(StrEnum):
    """Whether there is a completed model."""

    COMPLETED = "completed"
    NOTHING_ADDED = "nothing_added"  # the model as given
    NOT_PHYSICAL = "not_physical"  # the parameters that fit best are none of a structure


class CompletedModel(NamedTuple):
    """The model with what was found, or why there is none."""

    model: Structure | None
    status: CompletedStatus
    reason: str = ""


def completed_model(
    model: Structure,
    baseline: Mapping[str, float],
    kinds: tuple[str, ...],
    values: Mapping[str, float],
) -> CompletedModel:
    """The model with effects added and its own parameters at their most likely values.

    Arguments: `baseline` has new values of the model's own parameters, `values` those of the
    added effects, both by name. Where one of them is none that a structure can have, such as a
    negative frequency, there is no model but a reason.
    """
    if not kinds:
        return CompletedModel(model, CompletedStatus.NOTHING_ADDED)
    for name, value in baseline.items():
        rule = _RULES.get(name.rpartition(".")[2])
        if not np.isfinite(value) or (rule is not None and not rule.good(value)):
            expected = "finite" if rule is None else rule.expected
            return _refused(f"`{name}` must be {expected}, but is {value:.4g}.")
    try:
        added = tuple(
            make_effect(kind, {name: values[f"{kind}.{name}"] for name in effect_parameters(kind)})
            for kind in kinds
        )
    except ValueError as error:
        return _refused(str(error))
    moved = model
    if baseline:
        moved = with_parameters(model, tuple(baseline), jnp.array(list(baseline.values())))
    completed = dataclasses.replace(moved, effects=(*model.effects, *added))
    return CompletedModel(completed, CompletedStatus.COMPLETED)


def _refused(reason: str) -> CompletedModel:
    return CompletedModel(None, CompletedStatus.NOT_PHYSICAL, reason)
