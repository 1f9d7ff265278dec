"""Several methods on the same steady states: compare.csv, summary.json, a figure, report.html."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from snrmjax.io.files import write_atomically, write_summary
from snrmjax.io.tables import write_table
from snrmjax.io.units import HERTZ
from snrmjax.measure.states import SteadyStates
from snrmjax.methods.comparison import METHODS, Comparison, compare_methods
from snrmjax.methods.result import METHOD_MESSAGE, MethodResult, MethodStatus
from snrmjax.model.structures import Structure, modes_of
from snrmjax.report.html import Report, ReportFigure, ReportTable, Section, number, write_report
from snrmjax.report.style import (
    COLUMN,
    LINE,
    SERIES,
    fit_axis,
    legend,
    name_axes,
    panels,
    printed,
    unit_for,
)

_NAMES = {
    "snrm": "inverse SNRM",
    "concerto": "CONCERTO",
    "arslan_ozguven": "describing function",
    "rct": "response-controlled modal fit",
    "harmonic_force_surface": "harmonic force surface",
    "phase_resonance": "phase resonance",
}
_MARKERS = ("", "o", ".", "s", "D", "^")
_FEW = 40  # points that are drawn large
_CAPTION = (
    "Natural frequency and damping against the velocity amplitude at resonance, by each method "
    "from the same steady states. The line with its 95 % band is the inverse SNRM; methods that "
    "answer state by state or level by level are points. Far outliers are counted at the edge."
)


class MethodComparison(NamedTuple):
    """What the methods found, and the inverse SNRM's distance to each."""

    data: SteadyStates
    structure: Structure
    comparison: Comparison


def run_methods(
    data: SteadyStates, structure: Structure, methods: tuple[str, ...] | None = None
) -> MethodComparison:
    """Run the methods. Raises `ValueError` as `compare_methods` does."""
    return MethodComparison(data, structure, compare_methods(data, modes_of(structure), methods))


def write_comparison(folder: Path, found: MethodComparison, name: str) -> None:
    """Write compare.csv, summary.json, compare.png and report.html."""
    results = found.comparison.results
    columns: dict[str, list] = {
        "method": [one.method for one in results for _ in one.status],
    }
    kept = ("velocity_m_s", "frequency_hz", "frequency_std_hz", "damping_ratio")
    for key in (*kept, "damping_ratio_std", "status"):
        columns[key] = [value for one in results for value in np.asarray(one.variables()[key][1])]
    write_table(folder / "compare.csv", {key: np.array(rows) for key, rows in columns.items()})
    write_summary(folder / "summary.json", _summary(found))
    heading = "Backbones and damping"
    drawn = printed(methods_figure(results))
    write_atomically(folder / "compare.png", drawn.png)
    write_report(
        folder / "report.html",
        Report(
            title=f"Methods compared: {name}",
            done=[
                ("model", found.structure.name),
                ("steady states", str(found.data.n_states)),
                ("levels", str(len(np.unique(np.asarray(found.data.level))))),
            ],
            result=comparison_sentence(found),
            notes=_notes(found),
            sections=[Section(heading, (), [ReportFigure(drawn, _CAPTION)], [_table(found)])],
        ),
    )


def methods_figure(results: tuple[MethodResult, ...]) -> Figure:
    """Natural frequency and damping of every method against velocity."""
    figure, grid = panels(COLUMN, 5.6, 2, 1)
    every = np.concatenate([np.asarray(one.velocity)[one.found] for one in results])
    unit = unit_for(every, "m/s")
    values: list[list[np.ndarray]] = [[], []]
    for k, one in enumerate(results):
        at = one.found
        if not at.any():
            continue
        x = np.asarray(one.velocity)[at] / unit.size
        columns = (
            (one.natural_frequency / HERTZ, one.natural_frequency_std / HERTZ),
            (100 * one.damping_ratio, 100 * one.damping_ratio_std),
        )
        for axes, kept, (value, std) in zip(grid[:, 0], values, columns, strict=True):
            y, spread = (np.asarray(part)[at] for part in (value, std))
            colour, label = SERIES[k % len(SERIES)], _NAMES.get(one.method, one.method)
            kept.append(y)
            if one.method == "snrm":
                axes.plot(x, y, color=colour, linewidth=LINE, label=label)
                band = 1.96 * np.nan_to_num(spread)
                axes.fill_between(x, y - band, y + band, color=colour, alpha=0.2, linewidth=0)
            else:
                marker = _MARKERS[k % len(_MARKERS)] or "x"
                size = 4.0 if len(x) <= _FEW else 2.0
                style = {"markersize": size, "linestyle": "none", "zorder": 3 - 0.01 * len(x)}
                axes.plot(x, y, marker, color=colour, label=label, **style)
    titles = (("Natural frequency", "Natural frequency (Hz)"), ("Damping", "Damping ratio (%)"))
    for axes, kept, (title, label) in zip(grid[:, 0], values, titles, strict=True):
        name_axes(axes, title, f"Velocity amplitude ({unit.name})", label)
        fit_axis(axes, "y", np.concatenate(kept), kept[0])
    legend(figure)
    return figure


def comparison_sentence(found: MethodComparison) -> str:
    """The result in a plain sentence."""
    results, stopped = found.comparison
    text = f"{len(results)} of {len(results) + len(stopped)} methods ran"
    near = [one for one in _distances(found) if one[0] != "snrm"]
    if not near:
        return f"{text}."
    away = ", ".join(
        f"{_NAMES.get(name, name)} {number(hertz, 2)} Hz and {number(100 * ratio, 2)} %"
        for name, hertz, ratio, _ in near
    )
    return f"{text}. Median distance from the inverse SNRM in frequency and in damping: {away}."


def _distances(found: MethodComparison) -> list[tuple[str, float, float, int]]:
    """Of each method: median distances from the inverse SNRM in Hz and relative damping, points.

    At amplitudes that the inverse SNRM covers; empty where it did not run.
    """
    own = [one for one in found.comparison.results if one.method == "snrm"]
    if not own:
        return []
    at = np.asarray(own[0].velocity)
    rows = []
    for one in found.comparison.results:
        velocity = np.asarray(one.velocity)
        kept = one.found & (velocity >= at.min()) & (velocity <= at.max())
        if not kept.any():
            continue
        omega, ratio = (
            np.interp(velocity[kept], at, np.asarray(curve))
            for curve in (own[0].natural_frequency, own[0].damping_ratio)
        )
        hertz = np.abs(np.asarray(one.natural_frequency)[kept] - omega) / HERTZ
        damping = np.abs(np.asarray(one.damping_ratio)[kept] / ratio - 1)
        away = float(np.median(hertz)), float(np.median(damping))
        rows.append((one.method, *away, int(kept.sum())))
    return rows


def _notes(found: MethodComparison) -> list[str]:
    results, stopped = found.comparison
    own = [f"{_NAMES.get(one.method, one.method)}: {note}" for one in results for note in one.notes]
    return [*(f"did not run: {why}" for why in stopped.values()), *own]


def _summary(found: MethodComparison) -> dict:
    results, stopped = found.comparison
    near = {name: (hertz, ratio) for name, hertz, ratio, _ in _distances(found)}
    return {
        "methods": {
            one.method: {
                "points": int(one.found.sum()),
                "failed": int((~one.found).sum()),
                "states": one.n_states,
                "median_distance_from_snrm_hz": near.get(one.method, (None, None))[0],
                "median_relative_damping_distance_from_snrm": near.get(one.method, (None, None))[1],
                "notes": list(one.notes),
            }
            for one in results
        },
        "stopped": stopped,
    }


def _table(found: MethodComparison) -> ReportTable:
    near = {name: (hertz, ratio) for name, hertz, ratio, _ in _distances(found)}
    rows = []
    for name in METHODS:
        one = next((r for r in found.comparison.results if r.method == name), None)
        if one is None:
            if name in found.comparison.stopped:
                rows.append(
                    (_NAMES[name], "did not run", "", "", "", found.comparison.stopped[name])
                )
            continue
        away = near.get(name)
        gap = ("", "") if away is None else (number(away[0], 2), f"{number(100 * away[1], 2)} %")
        kinds = {MethodStatus(int(k)) for k in np.asarray(one.status)[~one.found]}
        why = "; ".join(METHOD_MESSAGE[kind] for kind in sorted(kinds))
        counts = (str(one.n_states), str(int(one.found.sum())))
        rows.append(
            (_NAMES[name], *counts, *gap, f"{int((~one.found).sum())}: {why}" if why else "")
        )
    header = ("method", "states", "points", "distance (Hz)", "distance of damping", "failed")
    caption = "Distances: medians over the method's points, from the inverse SNRM's curves."
    return ReportTable(header, rows, caption)
