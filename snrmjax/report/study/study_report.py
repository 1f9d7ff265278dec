"""The report of a study: summary.csv, main_effects.csv, figures and one page with all of it."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from snrmjax.io.files import write_atomically
from snrmjax.report.html import Report, ReportFigure, ReportTable, Section, number, write_report
from snrmjax.report.study.bands import SAMPLED, band_panels
from snrmjax.report.study.digest import (
    StudyDigest,
    digest,
    digest_notes,
    effects_frame,
    effects_table,
    ranked_effects,
    sampling_method,
)
from snrmjax.report.study.failures import most_telling, status_table
from snrmjax.report.study.scalars import Scalar, display
from snrmjax.report.study.study_figures import (
    bands_figure,
    counts_figure,
    distributions_figure,
    failures_figure,
    main_effects_figure,
)
from snrmjax.report.study.summary import summary_frame, summary_table
from snrmjax.report.style import printed

if TYPE_CHECKING:
    import xarray

_ROWS, _COLUMNS = 4, 4  # panels of a figure of main effects
_PANELS = 12  # of a figure of distributions
_SPREAD = ("n_folds", "n_isolated", "n_solved")  # counts whose distribution is worth a panel
_ANSWERS, _MOST_ANSWERS = ("verdict", "effects"), 12
_TELLING = 5  # quantities along which failures are drawn

DISTRIBUTIONS = (
    "How the outputs are distributed over the members. Lines are the median and, dotted, the ends "
    "of the 95 % range; what lies beyond the outermost thousandth on either side is counted in the "
    "last bars."
)
EFFECTS = (
    "Each output (rows) over each varied quantity (columns). Dots are some of the members, lines "
    "the mean of all members with that value, with its 95 % band. Above a panel: the share of the "
    "output's variance that the quantity makes alone. Dots far from the line that one panel shows "
    "are the work of the other quantities."
)
BANDS = (
    "Curves of all members: median, 95 % and all of them at each place. Where a response folds, it "
    "has several values at a frequency; the highest and the lowest are drawn apart. Bands end "
    "where fewer than nine tenths of the members have a curve: the rest would tell of itself only."
)
FAILED = (
    "Where members have no whole result: over the two quantities in which they differ most from "
    "the others, and the share that failed along each quantity, with its 95 % interval."
)


def write_study_report(folder: Path, data: "xarray.Dataset") -> StudyDigest:
    """Write summary.csv, main_effects.csv, the figures (PNG) and report.html of a study.

    Returns the study's numbers. Memory does not grow with the curves of the study: they are read
    block by block.
    """
    found = digest(data)
    notes = digest_notes(found, data)
    summary = summary_frame(found.summaries)
    write_atomically(folder / "summary.csv", summary.to_csv(index=False, lineterminator="\n"))
    if found.estimated:
        table = effects_frame(found.effects).to_csv(index=False, lineterminator="\n")
        write_atomically(folder / "main_effects.csv", table)
    sections = [
        one
        for one in (
            _distributions(folder, found),
            _effects(folder, found),
            _bands(folder, data),
            _answers(folder, data),
            _failures(folder, found, data),
        )
        if one is not None
    ]
    versions = [
        (name, str(data.attrs[f"{name}_version"]))
        for name in ("snrmjax", "jax", "numpy")
        if f"{name}_version" in data.attrs
    ]
    done = [("computed", str(data.attrs.get("computed", ""))), ("members", str(found.n_members))]
    done += [
        ("sampling", sampling_method(data)),
        ("varied", ", ".join(found.quantities)),
        *versions,
    ]
    report = Report(
        title=f"Study: {data.attrs.get('title', 'study')}",
        done=[pair for pair in done if pair[1]],
        result=study_sentence(found),
        notes=notes,
        sections=sections,
    )
    write_report(folder / "report.html", report)
    return found


def study_sentence(found: StudyDigest) -> str:
    """What a study found, in one or two plain sentences."""
    for panel in found.effects:
        last = panel.outputs[-1]  # of the largest force
        of_last = (last.name, last.at_force)
        row = next(s for s in found.summaries if (s.scalar.name, s.scalar.at_force) == of_last)
        shown = display(row.quantiles, last.unit)
        low, _, median, _, high = (number(v) for v in row.quantiles / shown.size)
        unit = f" {shown.unit}" if shown.unit else ""
        text = f"{last.title}: median {median}{unit}, 95 % of the members {low} to {high}{unit}"
        order = ranked_effects(panel.effects[-1])
        if order:
            name, one = order[0]
            text += f"; {name} alone makes {100 * max(one.share, 0.0):.0f} % of its variance"
        return f"{found.headline} {text}."
    return found.headline


def _saved(folder: Path, name: str, figure: Figure, caption: str) -> ReportFigure:
    done = printed(figure)
    write_atomically(folder / f"{name}.png", done.png)
    return ReportFigure(done, caption)


def _distributions(folder: Path, found: StudyDigest) -> Section:
    shown = [one for one in found.outputs if _is_drawn(one)]
    figures = []
    for k in range(0, len(shown), _PANELS):
        name = "distributions" if len(shown) <= _PANELS else f"distributions_{k // _PANELS + 1}"
        figure = distributions_figure(shown[k : k + _PANELS])
        figures.append(_saved(folder, name, figure, DISTRIBUTIONS))
    caption = "All outputs over the members; further quantiles are in summary.csv."
    rows = [
        row
        for row in found.summaries
        if not row.scalar.is_count or (row.varies and row.scalar.name in _SPREAD)
    ]
    return Section("Distributions", (), figures, [summary_table(rows, caption)])


def _is_drawn(output: list[Scalar]) -> bool:
    if output[0].is_count and output[0].name not in _SPREAD:
        return False
    return any(one.varies for one in output)


def _effects(folder: Path, found: StudyDigest) -> Section | None:
    if not found.quantities or not found.effects:
        return None
    figures = []
    for k in range(0, len(found.effects), _ROWS):
        shown = found.effects[k : k + _ROWS]
        strongest: dict[str, float] = dict.fromkeys(found.quantities, 0.0)
        for one in (effects for panel in shown for effects in panel.effects):
            for name, effect in ranked_effects(one):
                strongest[name] = max(strongest[name], effect.share)
        names = sorted(strongest, key=lambda name: -strongest[name])[:_COLUMNS]
        several = len(found.effects) > _ROWS
        name = f"main_effects_{k // _ROWS + 1}" if several else "main_effects"
        drawn = {name: found.quantities[name] for name in names}
        figure = main_effects_figure(shown, drawn, found.units)
        figures.append(_saved(folder, name, figure, EFFECTS))
    tables = [effects_table(found.effects)] if found.estimated else []
    return Section("Main effects", (), figures, tables)


def _bands(folder: Path, data: "xarray.Dataset") -> Section | None:
    shown = band_panels(data)
    if not shown:
        return None
    caption = BANDS
    if data.sizes["member"] > SAMPLED:
        caption += f" Medians and 95 % are those of {SAMPLED} members, drawn at random."
    return Section("Bands", (), [_saved(folder, "bands", bands_figure(shown), caption)])


def _answers(folder: Path, data: "xarray.Dataset") -> Section | None:
    """How often a diagnosis gave which answer."""
    names = [name for name in _ANSWERS if name in data]
    if not names:
        return None
    counts = [
        (name.capitalize(), dict(Counter(data[name].values.astype(str).tolist()).most_common()))
        for name in names
    ]
    drawn = [(name, dict(list(found.items())[:_MOST_ANSWERS])) for name, found in counts]
    n = data.sizes["member"]
    tables = [
        ReportTable(
            (name.lower(), "members", "share"),
            [(text or "none", str(k), f"{100 * k / n:.3g} %") for text, k in found.items()],
            folded=f"All answers: {name.lower()}",
        )
        for name, found in counts
    ]
    caption = "How often each answer was given over the members."
    figures = [_saved(folder, "answers", counts_figure(drawn), caption)]
    return Section("Answers", (), figures, tables)


def _failures(folder: Path, found: StudyDigest, data: "xarray.Dataset") -> Section:
    table = status_table(found.failures, data)
    if not found.failures.n_failed:
        return Section("Failures", ("Every member has its whole result.",), (), [table])
    text = f"{found.failures.n_failed} of {found.n_members} members have no whole result."
    if not found.quantities:
        return Section("Failures", (text,), (), [table])
    names = most_telling(found.quantities, found.failures.failed)[:_TELLING]
    drawn = {name: found.quantities[name] for name in names}
    figure = failures_figure(found.failures, drawn, found.units)
    return Section("Failures", (text,), [_saved(folder, "failures", figure, FAILED)], [table])
