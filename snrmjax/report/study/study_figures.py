"""Figures of a study: distributions, main effects, bands of its curves, where members failed."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snrmjax.report.html import number, ten_to
from snrmjax.report.sentences.study import readable
from snrmjax.report.style import (
    COLUMN,
    IDENTIFIED,
    LINE,
    MEASURED,
    PAGE,
    SERIES,
    SMALL,
    Style,
    legend,
    name_axes,
    panels,
    plain,
    unit_for,
)
from snrmjax.study.analysis.bands import Band, CurveBands
from snrmjax.study.analysis.digest import Failures, OutputEffects, failure_fraction
from snrmjax.study.analysis.outputs import Scalar, summarized
from snrmjax.study.uncertainty.sensitivity import FEWEST

_FEWEST_DIGITS, _MOST_DIGITS = -2, 4  # powers of ten that axes are written with
_PREFIXED = ("m/s", "N", "J")  # units shown with a prefix where numbers are small
_BINS = 40
_ROW = 2.3  # inches: the height of a row of panels
_ACROSS = 3  # panels side by side
_DOTS = 400  # of a scatter: more hide one another
_LINES = 3  # of a title: of the largest forces
_PALE, _CLOUD = 0.13, 0.35


class Display(NamedTuple):
    """How numbers are shown: divided by `size`, in `unit`."""

    size: float
    unit: str

    def labelled(self, text: str) -> str:
        """A label with the unit."""
        return f"{text} ({self.unit})" if self.unit else text


_PLAIN = Display(1.0, "")


def span_in_words(
    *values: float, ends: tuple[float, float] = (-np.inf, np.inf), shown: Display = _PLAIN
) -> str:
    """A value or a range; -inf and inf are below and above the ends of the range.

    >>> span_in_words(84.0, np.inf, ends=(70.0, 110.0))
    '84 to above 110'
    """
    beyond = {-np.inf: f"below {number(ends[0])}", np.inf: f"above {number(ends[1])}"}
    each = [beyond.get(value) or number(value / shown.size) for value in values]
    return " to ".join(dict.fromkeys(each) if values[0] in beyond else each)


def of_members(known: int, members: int) -> str:
    """The number of members that a statement refers to.

    >>> of_members(27, 100), of_members(100, 100)
    ('27 of 100 members', '100 members')
    """
    return f"{members} members" if known == members else f"{known} of {members} members"


def display(values: Float[np.ndarray, "..."], unit: str) -> Display:
    """The unit, with a prefix where suitable, in which to show values."""
    if unit in _PREFIXED and np.any(np.isfinite(values)):
        return Display(*unit_for(values, unit))
    return Display(1.0, "" if unit == "1" else unit)


def display_on_axis(values: Float[np.ndarray, "..."], unit: str) -> Display:
    """The same for an axis, with a power of ten where numbers are very large or very small."""
    shown = display(values, unit)
    largest = np.max(np.abs(values), initial=0.0, where=np.isfinite(values)) / shown.size
    power = 0 if largest == 0 else int(np.floor(np.log10(largest)))
    if _FEWEST_DIGITS <= power <= _MOST_DIGITS:
        return shown
    return Display(shown.size * 10.0**power, f"{ten_to(power)} {shown.unit}".rstrip())


def distributions_figure(outputs: Sequence[Sequence[Scalar]]) -> Figure:
    """Histograms of outputs, one panel each, with median and 95 % range; a colour for each force.

    Arguments: each of `outputs` is one output, for every force.
    """
    figure, grid = _grid(len(outputs), _ROW, 0.3)
    for axes, output in zip(grid, outputs, strict=True):
        _histogram(axes, output)
    legend(figure)
    return figure


def _grid(n: int, row: float, legends: float) -> tuple[Figure, list[Axes]]:
    """A figure of n panels in rows; heights in inches."""
    columns = min(_ACROSS, n)
    rows = -(-n // columns)
    width = PAGE if columns > 1 else COLUMN
    figure, grid = panels(width, row * rows + legends, rows, columns)
    for axes in grid.flat[n:]:
        axes.set_visible(False)
    return figure, list(grid.flat[:n])


def _histogram(axes: Axes, output: Sequence[Scalar]) -> None:
    pooled = np.concatenate([one.values for one in output])
    known = pooled[np.isfinite(pooled)]
    shown = display_on_axis(known, output[0].unit)
    if output[0].is_count:
        edges = np.arange(known.min() - 0.5, known.max() + 1.0)
    else:
        # Far outliers get no bins of their own: the rest would be one bar.
        low, high = np.quantile(known, [0.001, 0.999])
        edges = np.linspace(low, high, _bins(known.size)) / shown.size
    for one, colour in zip(output, _colours(len(output)), strict=True):
        values = one.values[np.isfinite(one.values)] / shown.size
        if not values.size:
            continue
        name = _force(one.force) or "members"
        low, _, median, _, high = summarized(one).quantiles / shown.size
        drawn: Style = {"color": colour, "alpha": 0.45, "label": name}
        axes.hist(np.clip(values, edges[0], edges[-1]), edges.tolist(), **drawn)
        if not one.is_count:
            for at, style in ((median, "-"), (low, ":"), (high, ":")):
                width = LINE if style == "-" else 0.9
                if np.isfinite(at):
                    axes.axvline(at, color=colour, linewidth=width, linestyle=style)
    if not output[0].is_count:
        axes.plot([], [], color="0.3", linewidth=LINE, label="median")
        axes.plot([], [], ":", color="0.3", linewidth=0.9, label="95 % range")
    title = plain(f"{readable(output[0].name)}{_part(output)}")
    name_axes(axes, title, plain(shown.unit), "Members")


def _part(output: Sequence[Scalar]) -> str:
    """Members with a value and outside the range, one line per force where some have none."""
    lines = []
    for row in map(summarized, output):
        known = row.described - row.outside
        if known < row.members:
            sides = ((row.below, "below"), (row.above, "above"))
            beyond = [f"{n} {where}" for n, where in sides if n]
            force = [_force(row.scalar.force)] if row.scalar.force is not None else []
            lines.append(", ".join([*force, of_members(known, row.members), *beyond]))
    return "".join(f"\n{line}" for line in lines[-_LINES:])


def main_effects_figure(
    shown: Sequence[OutputEffects],
    quantities: dict[str, Float[np.ndarray, " member"]],
    units: dict[str, str],
) -> Figure:
    """Each output (rows) over each quantity (columns): members, conditional mean and its band."""
    names = list(quantities)
    width = PAGE if len(names) > 1 else COLUMN
    figure, grid = panels(width, _ROW * len(shown) + 0.4, len(shown), len(names))
    for k, (line, one) in enumerate(zip(grid, shown, strict=True)):
        pooled = np.concatenate([output.values for output in one.outputs])
        y = display_on_axis(pooled, one.outputs[0].unit)
        for j, (axes, name) in enumerate(zip(line, names, strict=True)):
            x = display_on_axis(quantities[name], units[name])
            _scatter(axes, one, name, quantities[name], (x, y))
            broken = name.replace(".", ".\n", 1) if len(names) > _ACROSS else name
            below = plain(x.labelled(broken)) if k == len(shown) - 1 else ""
            label = plain(y.labelled(readable(one.outputs[0].name))) if j == 0 else ""
            name_axes(axes, "", below, label)
            _fraction(axes, one, name)
            if j:
                axes.sharey(line[0])
                axes.tick_params(labelleft=False)
            if k < len(shown) - 1:
                axes.tick_params(labelbottom=False)
    legend(figure)
    return figure


def _scatter(
    axes: Axes,
    shown: OutputEffects,
    name: str,
    quantity: np.ndarray,
    units: tuple[Display, Display],
) -> None:
    x, y = units
    chosen = _thinned(len(quantity))
    colours = _colours(len(shown.outputs))
    for output, effects, colour in zip(shown.outputs, shown.effects, colours, strict=True):
        effect, few = effects[name], output.n_known < FEWEST
        diameter, alpha = (8.0, 0.9) if few else (2.5, _CLOUD)
        dots: Style = {"linestyle": "none", "marker": ".", "markersize": diameter, "alpha": alpha}
        values = output.values[chosen] / y.size
        # Where no mean is drawn, only the dots distinguish the forces.
        named = _force(output.force) if effect is None else ""
        axes.plot(
            *(quantity[chosen] / x.size, values),
            **dots,
            color=colour,
            markeredgewidth=0.0,
            label=named or None,
        )
        if effect is None:
            continue
        at, mean, error = effect.at / x.size, effect.mean / y.size, effect.error / y.size
        band: Style = {"color": colour, "alpha": 0.35, "linewidth": 0}
        axes.fill_between(at, mean - error, mean + error, **band)
        named = f"mean {_force(output.force)}".rstrip()
        axes.plot(at, mean, color=colour, linewidth=1.6, label=named)
    axes.plot([], [], ".", color="0.4", markersize=4.0, label="members")


def _fraction(axes: Axes, shown: OutputEffects, name: str) -> None:
    """Fraction of variance above a panel, range over the forces, and the members it refers to."""
    known = [effects[name] for effects in shown.effects]
    fractions = [100 * max(one.fraction, 0.0) for one in known if one is not None]
    words = []
    if fractions:
        low, high = (f"{value:.0f}" for value in (min(fractions), max(fractions)))
        words.append(f"{low} %" if low == high else f"{low} to {high} %")
    least, members = min(one.n_known for one in shown.outputs), len(shown.outputs[0].values)
    if least < members:
        words.append(of_members(least, members))
    axes.set_title(", ".join(words), loc="left", fontsize=SMALL, color="0.25")


def bands_figure(shown: Sequence[CurveBands]) -> Figure:
    """Bands of curves over all members, a panel for each force or curve."""
    figure, grid = _grid(len(shown), 2.8, 0.4)
    several = any(panel.lower is not None for panel in shown)
    for panel, axes in zip(shown, grid, strict=True):
        alike = [one.upper.most for one in shown if one.y == panel.y]
        y = display_on_axis(np.concatenate(alike), _unit(panel.y))
        x = display_on_axis(panel.upper.at, _unit(panel.x))
        _band(axes, panel.upper, (x, y), MEASURED, "highest value" if several else "")
        if panel.lower is not None:
            _band(axes, panel.lower, (x, y), IDENTIFIED, "lowest value")
        words = x.labelled(readable(panel.x)), y.labelled(readable(panel.y))
        name_axes(axes, _force(panel.force), *words)
    legend(figure)
    return figure


def _band(axes: Axes, band: Band, units: tuple[Display, Display], colour: str, which: str) -> None:
    x, y = units
    at, end = band.at / x.size, f", {which}" if which else ""
    low, high = band.low / y.size, band.high / y.size
    none: Style = {"linewidth": 0, "color": colour}
    least, most = band.least / y.size, band.most / y.size
    axes.fill_between(at, least, most, alpha=_PALE, label=f"all members{end}", **none)
    axes.fill_between(at, low, high, alpha=0.3, label=f"95 %{end}", **none)
    axes.plot(at, band.median / y.size, color=colour, linewidth=LINE, label=f"median{end}")


def failures_figure(
    failures: Failures,
    quantities: dict[str, Float[np.ndarray, " member"]],
    units: dict[str, str],
) -> Figure:
    """Where members failed: over the two most influential quantities, and the fraction along each.

    Arguments: `quantities` in the order in which they distinguish failed from complete members.
    """
    names = list(quantities)
    figure, grid = _grid(len(names) + 1, 2.6, 0.5)
    _map(grid[0], failures, [quantities[name] for name in names[:2]])
    second = plain(_named(names[1], units)) if len(names) > 1 else "Number of the member"
    name_axes(grid[0], "Failed members", plain(_named(names[0], units)), second)
    for axes, name in zip(grid[1:], names, strict=True):
        along = failure_fraction(quantities[name], failures.failed)
        middle = 0.5 * (along.edges[1:] + along.edges[:-1])
        shown: Style = {"color": IDENTIFIED, "alpha": 0.35}
        axes.bar(
            middle, 100 * along.fraction, np.diff(along.edges), **shown, label="fraction failed"
        )
        bars = 100 * np.abs(np.array([along.fraction - along.low, along.high - along.fraction]))
        style: Style = {"fmt": "none", "ecolor": "0.3", "elinewidth": 0.8}
        axes.errorbar(middle, 100 * along.fraction, bars, **style, label="95 % interval")
        name_axes(axes, "", plain(_named(name, units)), "Failed (%)")
    legend(figure)
    return figure


def _map(axes: Axes, failures: Failures, positions: Sequence[np.ndarray]) -> None:
    x = positions[0]
    y = positions[1] if len(positions) > 1 else np.arange(len(x))
    complete = np.flatnonzero(~failures.failed)
    complete = complete[_thinned(len(complete))]
    dots: Style = {"linestyle": "none", "marker": ".", "markersize": 3.0, "markeredgewidth": 0.0}
    axes.plot(x[complete], y[complete], **dots, color="0.7", label="complete")
    kinds = list(failures.failed_counts)
    groups = [(kind, [kind]) for kind in kinds[: len(SERIES) - 1]]
    if len(kinds) >= len(SERIES):
        groups.append(("other statuses", kinds[len(SERIES) - 1 :]))
    for (name, those), colour in zip(groups, SERIES, strict=False):
        mine = np.flatnonzero(failures.failed & np.isin(failures.status, those))
        mine = mine[_thinned(len(mine))]
        cross: Style = {"linestyle": "none", "marker": "x", "markersize": 4.0}
        axes.plot(x[mine], y[mine], **cross, color=colour, label=plain(short_name(name)))


def counts_figure(counts: Sequence[tuple[str, dict[str, int]]]) -> Figure:
    """How often each answer was given: one panel a question, such as the verdict."""
    figure, (line,) = panels(PAGE if len(counts) > 1 else COLUMN, 2.8, 1, len(counts))
    for axes, (title, answers) in zip(line, counts, strict=True):
        names = [short_name(name) for name in answers]
        axes.barh(np.arange(len(answers)), list(answers.values()), color=MEASURED, alpha=0.6)
        axes.set_yticks(np.arange(len(answers)), [plain(name or "none") for name in names])
        axes.invert_yaxis()
        name_axes(axes, title, "Members", "")
    return figure


def short_name(name: str, longest: int = 28) -> str:
    """A status or an answer of at most so many letters."""
    return name if len(name) <= longest else f"{name[:longest]} …"


def _force(force: float | None) -> str:
    return "" if force is None else f"{force:.4g} N"


def _unit(name: str) -> str:
    return "Hz" if name.endswith("_hz") else "m/s" if name.endswith("_m_s") else ""


def _named(name: str, units: dict[str, str]) -> str:
    return f"{name} ({units[name]})" if units[name] else name


def _colours(n: int) -> Iterable[str]:
    if n == 1:
        return (MEASURED,)
    return [SERIES[k % len(SERIES)] for k in range(n)]


def _bins(n: int) -> int:
    return int(np.clip(np.sqrt(n), 8, _BINS)) + 1


def _thinned(n: int) -> np.ndarray:
    """Indices of at most `_DOTS` of n members, drawn at random: every k-th may be a pattern."""
    if n <= _DOTS:
        return np.arange(n)
    return np.sort(np.random.default_rng(0).choice(n, _DOTS, replace=False))
