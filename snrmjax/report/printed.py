"""Results on one screen, as `print(result)` shows them, and as tables in notebooks."""

import dataclasses
import html
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, AbstractShown, Variable
from snrmjax.numerics.status import Status
from snrmjax.numerics.units import unit_in_print

_LINES = 8  # of quantities on one screen, and of parameters that a notebook does not fold
_LEFT = 'style="text-align: left"'


def screen_of(shown: AbstractShown) -> str:
    """A result on one screen: its class, dimensions, ranges, statuses and notes."""
    variables = shown.variables() if isinstance(shown, AbstractResult) else {}
    ranges = [f"{what} {span}" if span else f"{what}: none" for what, span, _ in _ranges(variables)]
    first, *others = _lines(shown, variables, ranges[:_LINES])
    return "\n".join([first, *(f"  {line}" for line in others)])


def html_of(shown: AbstractShown) -> str:
    """A result as a notebook shows it: the lines of its screen, and its quantities as a table.

    In the colours of the page around it, light or dark.
    """
    variables = shown.variables() if isinstance(shown, AbstractResult) else {}
    first, *others = _lines(shown, variables)
    parts = [f"<strong>{html.escape(first)}</strong>"]
    if others:
        items = "".join(f"<li>{html.escape(line)}</li>" for line in others)
        parts.append(f"<ul>{items}</ul>")
    parameters = list(_parameters(variables))
    if parameters:
        counted = f"{len(parameters)} parameter{'' if len(parameters) == 1 else 's'}"
        shut = "" if len(parameters) > _LINES else " open"
        table = _table(("parameter", "value", "1σ"), parameters)
        parts.append(f"<details{shut}><summary>{counted}</summary>{table}</details>")
    rows = [row for row in _ranges(variables) if row[1]]
    if rows:
        parts.append(_table(("quantity", "value or range", "1σ"), rows))
    return f"<div>{''.join(parts)}</div>"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table, without the columns that no row fills."""
    filled = [k for k in range(len(header)) if any(row[k] for row in rows)]

    def line(cells: Sequence[str], kind: str) -> str:
        texts = (html.escape(cells[k]) for k in filled)
        return f"<tr>{''.join(f'<{kind} {_LEFT}>{text}</{kind}>' for text in texts)}</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f"<table><thead>{line(header, 'th')}</thead><tbody>{body}</tbody></table>"


def _lines(
    shown: AbstractShown, variables: Mapping[str, Variable], ranges: Iterable[str] = ()
) -> tuple[str, ...]:
    """The lines that describe a result; with ranges where it has no summary of its own."""
    if hasattr(shown, "summary"):
        return shown.summary()
    return (_head(shown, variables), *_settings(shown), *ranges, *_ends(shown))


def _head(result: AbstractShown, variables: Mapping[str, Variable]) -> str:
    sizes: dict[str, int] = {}
    for variable in variables.values():
        sizes |= dict(zip(variable.dimensions, np.shape(variable.values), strict=True))
    listed = ", ".join(_counted(size, name, variables) for name, size in sizes.items())
    return f"{type(result).__name__}: {listed}" if listed else type(result).__name__


def _counted(size: int, dimension: str, variables: Mapping[str, Variable]) -> str:
    """The number of items along a dimension, or of values of the quantity along it."""
    several = "" if size == 1 else "s"
    if dimension in variables and variables[dimension].unit not in ("", "1"):
        return f"{size} value{several} of {dimension}"
    return f"{size} {dimension.replace('_', ' ')}{several}"


def _settings(result: AbstractShown) -> Iterator[str]:
    """One line a setting, notes and statuses aside."""
    for field in dataclasses.fields(result):
        value = getattr(result, field.name)
        if "setting" in field.metadata and not isinstance(value, Status | tuple | list):
            yield f"{field.name.replace('_', ' ')}: {value}"


def _ranges(variables: Mapping[str, Variable]) -> Iterator[tuple[str, str, str]]:
    """Every quantity with its range, or its value where it is one number, and that of its 1σ."""
    errors = {name.replace("_std", "", 1): of for name, of in variables.items() if "_std" in name}
    mixed = {"value", "std"} if "unit" in variables else set()  # each in a unit of its own
    for name, of in variables.items():
        if np.asarray(of.values).dtype.kind in "fiuc" and "_std" not in name and name not in mixed:
            yield of.meaning, _range(of), _range(errors[name], 2) if name in errors else ""


def _parameters(variables: Mapping[str, Variable]) -> Iterator[tuple[str, str, str]]:
    """Every named parameter of a fit with its value and 1σ, each in its unit."""
    if "unit" not in variables:
        return
    std = variables["value_std" if "value_std" in variables else "std"]
    columns = (variables["parameter"], variables["value"], std, variables["unit"])
    for name, value, error, unit in zip(*(of.values for of in columns), strict=True):
        after = f" {unit_in_print(unit)}".rstrip()
        yield name, f"{value:.6g}{after}", f"{error:.2g}{after}" if np.isfinite(error) else ""


def _range(of: Variable, digits: int = 6) -> str:
    """The range of a quantity with its unit; empty where no value of it is finite."""
    values = np.asarray(of.values)
    finite = values[np.isfinite(values)]
    if not finite.size:
        return ""
    magnitudes = np.abs(finite) if values.dtype.kind == "c" else finite
    low, high, unit = magnitudes.min(), magnitudes.max(), f" {unit_in_print(of.unit)}".rstrip()
    ends = dict.fromkeys(f"{end:.{digits}g}" for end in (low, high))  # one where they are alike
    return f"{' to '.join(ends)}{unit}"


def _ends(result: AbstractShown) -> Iterator[str]:
    """Statuses with their messages, and notes."""
    for field in dataclasses.fields(result):
        value, about = getattr(result, field.name), field.metadata.get("quantity")
        if about is not None and about.of is not None:
            for number, count in sorted(Counter(np.ravel(value).tolist()).items()):
                yield f"{count} {about.of(int(number)).message}"
        elif isinstance(value, Status):
            yield f"status: {value.message}"
        elif isinstance(value, tuple):
            yield from (f"note: {one}" for one in value if isinstance(one, Fact))
