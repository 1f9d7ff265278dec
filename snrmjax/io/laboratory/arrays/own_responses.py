"""Frequency responses in the layout in which we write them, MATLAB and netCDF alike."""

from collections.abc import Mapping

import numpy as np

from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers
from snrmjax.io.laboratory.libraries import Budget
from snrmjax.io.units import HERTZ
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses

_ARRAYS = ("frequency_hz", "value_re", "value_im", "coherence")
_NAMES = ("response", "reference")


def take_responses(
    tree: Mapping[str, Node], budget: Budget
) -> tuple[list[tuple[FrequencyResponses, float]], dict[str, Node]]:
    """Responses with their levels (NaN where none is stated), and what is left of the tree.

    They are the tree itself, a struct in it, or a list of structs.
    """
    own = _responses(tree, budget)
    if own is not None:
        kept = {
            key: node for key, node in tree.items() if key not in (*_ARRAYS, *_NAMES, "level_value")
        }
        return [own], kept
    found: list[tuple[FrequencyResponses, float]] = []
    rest: dict[str, Node] = {}
    for key, node in tree.items():
        structs = node if isinstance(node, list) else [node]
        taken = [_responses(one, budget) for one in structs if isinstance(one, dict)]
        good = [one for one in taken if one is not None]
        if good and len(good) == len(structs):
            found.extend(good)
        else:
            rest[key] = node
    return found, rest


def _responses(tree: Mapping[str, Node], budget: Budget) -> tuple[FrequencyResponses, float] | None:
    arrays = [one for one in map(tree.get, _ARRAYS) if isinstance(one, Numbers)]
    names = [_texts(tree.get(key)) for key in _NAMES]
    if len(arrays) < len(_ARRAYS) or not all(names):
        return None
    outputs, inputs = ([_channel(name) for name in one] for one in names)
    hertz = arrays[0].vector(budget, "responses")
    shape = (len(outputs), len(inputs), hertz.size)
    if any(one.size != np.prod(shape) or one.is_complex for one in arrays[1:]):
        return None
    real, imaginary, coherence = (one.all(budget, "responses").reshape(shape) for one in arrays[1:])
    values = np.empty(shape, dtype=complex)
    values.real, values.imag = real, imaginary
    level = tree.get("level_value")
    stated = isinstance(level, Numbers) and level.size == 1 and not level.is_complex
    return (
        frequency_responses(hertz * HERTZ, values, outputs, inputs, coherence=coherence),
        float(level.vector(budget, "level")[0])
        if stated and isinstance(level, Numbers)
        else np.nan,
    )


def _texts(node: Node | None) -> list[str]:
    if isinstance(node, str):
        return [node]
    return [one for one in node if isinstance(one, str)] if isinstance(node, list) else []


def _channel(text: str) -> Channel:
    """A channel of the line `name|quantity|unit|point|direction` that the writer makes."""
    parts = text.rsplit("|", 4)
    if len(parts) != 5:
        return Channel(text)
    name, quantity, unit, point, direction = parts
    known = {"force", "displacement", "velocity", "acceleration", "voltage"}
    return Channel(
        name,
        quantity if quantity in known else "unknown",  # type: ignore[arg-type]
        unit,
        1.0,
        point,
        direction,
    )
