"""Results on one screen, as `print(result)` shows them."""

import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.status import Status

_LINES = 8  # of quantities on one screen


def screen_of(result: AbstractResult) -> str:
    """A result on one screen: what it is, how much of it, ranges, statuses, notes."""
    if hasattr(result, "summary"):
        first, *others = result.summary()
    else:
        variables = result.variables()
        first = _head(result, variables)
        others = [*_settings(result), *list(_ranges(variables))[:_LINES], *_ends(result)]
    return "\n".join([first, *(f"  {line}" for line in others)])


def _head(result: AbstractResult, variables: Mapping[str, Variable]) -> str:
    sizes: dict[str, int] = {}
    for variable in variables.values():
        sizes |= dict(zip(variable.dimensions, np.shape(variable.values), strict=True))
    listed = ", ".join(f"{size} {name}{'' if size == 1 else 's'}" for name, size in sizes.items())
    return f"{type(result).__name__}: {listed}" if listed else type(result).__name__


def _settings(result: AbstractResult) -> Iterator[str]:
    """One line a setting, notes and statuses aside."""
    for field in dataclasses.fields(result):
        value = getattr(result, field.name)
        if "setting" in field.metadata and not isinstance(value, Status | tuple | list):
            yield f"{field.name.replace('_', ' ')}: {value}"


def _ranges(variables: Mapping[str, Variable]) -> Iterator[str]:
    """One line a quantity: its range, or its value and 1σ where it is a single number."""
    for name, of in variables.items():
        values = np.asarray(of.values)
        if values.dtype.kind not in "fiuc" or "_std" in name:
            continue
        finite = (
            np.abs(values[np.isfinite(values)])
            if values.dtype.kind == "c"
            else values[np.isfinite(values)]
        )
        unit = "" if of.unit == "1" else f" {of.unit}"
        if not finite.size:
            yield f"{of.meaning}: none"
        elif finite.min() == finite.max():
            yield f"{of.meaning} {finite.min():.6g}{unit}"
        else:
            yield f"{of.meaning} {finite.min():.6g} to {finite.max():.6g}{unit}"


def _ends(result: AbstractResult) -> Iterator[str]:
    """Statuses with what they say, and notes."""
    for field in dataclasses.fields(result):
        value, about = getattr(result, field.name), field.metadata.get("quantity")
        if about is not None and about.of is not None:
            for number, count in sorted(Counter(np.ravel(value).tolist()).items()):
                yield f"{count} {about.of(int(number)).message}"
        elif isinstance(value, Status):
            yield f"status: {value.message}"
        elif isinstance(value, tuple):
            yield from (f"note: {one}" for one in value if isinstance(one, Fact))
