"""Several methods on the same tests: compare.csv, summary.json, a figure, report.html."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from snrmjax.io.files import write_atomically, write_summary
from snrmjax.io.tables import write_table
from snrmjax.methods.comparison import METHODS, RECORD_METHODS, Comparison
from snrmjax.methods.result import MethodResult, MethodStatus
from snrmjax.numerics.units import HERTZ
from snrmjax.report.html import Report, ReportFigure, ReportTable, Section, number, write_report
from snrmjax.report.style import (
    COLUMN,
    SERIES,
    Style,
    banded,
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
    "resonant_decay": "resonant decay",
    "restoring_force": "restoring-force surface",
    "ssm": "spectral submanifold",
    "pnlss": "nonlinear state space",
}
_EVERY = (*METHODS, *RECORD_METHODS)
# Methods that give curves are drawn as lines, those that answer state by state as points.
_LINES = {"snrm": "-", "restoring_force": "--", "ssm": "-.", "pnlss": ":"}
_MARKERS = ("o", ".", "s", "D", "^", "v", "x")
# Methods whose 1σ includes noise only, and those that also assume polynomial forces.
_OF_NOISE = ("concerto", "arslan_ozguven", "rct", "phase_resonance")
_OF_POLYNOMIALS = ("pnlss",)
_AWAY = ("median_distance_from_snrm_hz", "median_relative_damping_distance_from_snrm")
_FEW = 40  # points that are drawn large
_CAPTION = (
    "Natural frequency and damping against the velocity amplitude at resonance, by each method "
    "from the same tests. Lines with 95 % bands are methods that give curves (the restoring-force "
    "surface of a forced record gives no band); methods that answer state by state, level by "
    "level or cycle by cycle are points. Far outliers are counted at the edge."
)


def write(folder: Path, found: Comparison, *, title: str = "", model: str = "") -> Report:
    """Write compare.csv, summary.json, compare.png and report.html."""
    results = found.results
    columns: dict[str, list] = {
        "method": [result.method for result in results for _ in result.status],
    }
    kept = ("velocity_m_s", "frequency_hz", "frequency_std_hz", "damping_ratio")
    for key in (*kept, "damping_ratio_std", "status"):
        columns[key] = [
            value for result in results for value in np.asarray(result.variables()[key][1])
        ]
    write_table(folder / "compare.csv", {key: np.array(rows) for key, rows in columns.items()})
    write_summary(folder / "summary.json", _summary(found))
    heading = "Backbones and damping"
    drawn = printed(methods_figure(results))
    write_atomically(folder / "compare.png", drawn.png)
    report = Report(
        title=f"Methods compared: {title}",
        done=[("model", model), *_done(found)],
        result=comparison_sentence(found),
        notes=_notes(found),
        sections=[Section(heading, (), [ReportFigure(drawn, _CAPTION)], [_table(found)])],
    )
    write_report(folder / "report.html", report)
    return report


def headline(found: Comparison) -> list[str]:
    """How each record was classified, interfering modes of decays, and the result."""
    return [*map(str, (*found.records, *found.decays)), comparison_sentence(found)]


def notes_of(found: Comparison) -> list[str]:
    """Why methods did not run."""
    return [f"did not run: {why}" for why in found.stopped.values()]


def _done(found: Comparison) -> list[tuple[str, str]]:
    """The inputs, for the line under the title."""
    rows = []
    data, records = found.data, found.records
    if data is not None:
        rows.append(("steady states", str(data.n_states)))
        rows.append(("levels", str(len(np.unique(np.asarray(data.level))))))
    if records:
        rows.append(("time records", str(len(records))))
    return rows


def methods_figure(results: tuple[MethodResult, ...]) -> Figure:
    """Natural frequency and damping of every method against velocity."""
    figure, grid = panels(COLUMN, 5.6, 2, 1)
    every = np.concatenate([np.asarray(result.velocity)[result.has_result] for result in results])
    unit = unit_for(every, "m/s")
    values: list[list[np.ndarray]] = [[], []]
    for k, one in enumerate(results):
        at = one.has_result
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
            if one.method in _LINES:
                style: Style = {"linestyle": _LINES[one.method], "zorder": 2}
                band = 1.96 * np.nan_to_num(spread)
                level = np.asarray(one.level)[at]
                for count, run in enumerate(np.unique(level)):  # a curve for each record
                    own = level == run
                    name = label if count == 0 else None
                    banded(axes, x[own], y[own], band[own], colour, name, band=None, **style)
            else:
                size = 4.0 if len(x) <= _FEW else 2.0
                style = {"markersize": size, "linestyle": "none", "zorder": 3 - 0.01 * len(x)}
                axes.plot(x, y, _MARKERS[k % len(_MARKERS)], color=colour, label=label, **style)
    titles = (("Natural frequency", "Natural frequency (Hz)"), ("Damping", "Damping ratio (%)"))
    for axes, kept, (title, label) in zip(grid[:, 0], values, titles, strict=True):
        name_axes(axes, title, f"Velocity amplitude ({unit.name})", label)
        fit_axis(axes, "y", np.concatenate([*kept, []]), kept[0] if kept else ())
    legend(figure)
    return figure


def comparison_sentence(found: Comparison) -> str:
    """The result in a plain sentence."""
    results, stopped = found.results, found.stopped
    text = f"{len(results)} of {len(results) + len(stopped)} methods ran"
    own, distances = found.reference, found.distances()
    near = [d for d in distances if own is not None and d.method != own.method]
    if own is None or not near:
        return f"{text}."
    away = ", ".join(
        f"{_NAMES.get(d.method, d.method)} {number(d.frequency / HERTZ, 2)} Hz and "
        f"{number(100 * d.damping, 2)} %"
        for d in near
    )
    return (
        f"{text}. Median distance from the {_NAMES[own.method]} in frequency and in damping: "
        f"{away}."
    )


def _notes(found: Comparison) -> list[str]:
    results = found.results
    own = [
        f"{_NAMES.get(result.method, result.method)}: {note}"
        for result in results
        for note in result.notes
    ]
    about = map(str, (*found.records, *found.decays))
    return [*about, *notes_of(found), *notes_on_bands(results), *own]


def notes_on_bands(results: Sequence[MethodResult]) -> list[str]:
    """Sentences on bands that do not include all errors of their method."""
    banded = [
        result.method
        for result in results
        if np.isfinite(np.asarray(result.natural_frequency_std)[result.has_result]).any()
    ]
    noise, polynomial = (
        " and ".join(_NAMES[name] for name in banded if name in kind)
        for kind in (_OF_NOISE, _OF_POLYNOMIALS)
    )
    notes = []
    if noise:
        notes.append(
            f"the bands of {noise} include noise only: what the method itself neglects is not in "
            "them, and dominates where noise is low."
        )
    if polynomial:
        notes.append(
            f"the bands of {polynomial} include noise only and assume polynomial forces: with "
            "friction, stops or v|v| damping they are too narrow."
        )
    return notes


def _summary(found: Comparison) -> dict:
    results, stopped = found.results, found.stopped
    reference = found.reference
    own = reference is not None and reference.method == "snrm"
    near = {d.method: (d.frequency / HERTZ, d.damping) for d in found.distances() if own}
    return {
        "records": [str(record) for record in found.records],
        "decays": [str(note) for note in found.decays],
        "bands": notes_on_bands(results),
        "methods": {
            result.method: {
                "points": int(result.has_result.sum()),
                "failed": int((~result.has_result).sum()),
                "states": result.n_states,
                "record_s": result.test_seconds,
                **dict(zip(_AWAY, near.get(result.method, (None, None)), strict=True)),
                "notes": [str(note) for note in result.notes],
            }
            for result in results
        },
        "stopped": stopped,
    }


def _table(found: Comparison) -> ReportTable:
    near = {d.method: (d.frequency / HERTZ, d.damping) for d in found.distances()}
    rows = []
    for name in _EVERY:
        one = next((r for r in found.results if r.method == name), None)
        if one is None:
            if name in found.stopped:
                rows.append((_NAMES[name], "did not run", "", "", "", found.stopped[name]))
            continue
        away = near.get(name)
        gap = ("", "") if away is None else (number(away[0], 2), f"{number(100 * away[1], 2)} %")
        kinds = {MethodStatus(int(k)) for k in np.asarray(one.status)[~one.has_result]}
        why = "; ".join(kind.message for kind in sorted(kinds))
        used = str(one.n_states)
        if np.isfinite(one.test_seconds):
            used = f"{number(one.test_seconds, 3)} s"
        counts = (used, str(int(one.has_result.sum())))
        rows.append(
            (_NAMES[name], *counts, *gap, f"{int((~one.has_result).sum())}: {why}" if why else "")
        )
    own = found.reference
    of = "" if own is None else f" of the {_NAMES[own.method]}"
    header = (
        "method",
        "states or record",
        "points",
        "distance (Hz)",
        "distance of damping",
        "failed",
    )
    caption = f"Distances: medians over the method's points, from the curves{of}."
    return ReportTable(header, rows, caption)
