"""The report of a study: summary.csv, main_effects.csv, figures and one page with all of it."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from snrmjax.io.files import write_atomically
from snrmjax.report.html import Report, ReportFigure, ReportTable, Section, number, write_report
from snrmjax.report.sentences.study import readable
from snrmjax.report.study.study_figures import (
    bands_figure,
    counts_figure,
    display,
    distributions_figure,
    failures_figure,
    main_effects_figure,
    of_members,
    short_name,
    span_in_words,
)
from snrmjax.report.style import printed
from snrmjax.study.analysis.bands import SAMPLED, curve_bands
from snrmjax.study.analysis.digest import (
    StudyDigest,
    digest,
    effects_frame,
    ranked_by_failure,
    ranked_effects,
)
from snrmjax.study.analysis.outputs import ScalarSummary, summary_frame
from snrmjax.study.computations.base import COMPLETE, FORCE, MEMBER
from snrmjax.study.uncertainty.sensitivity import MainEffect

if TYPE_CHECKING:
    import pandas
    import xarray

_RANKS = 3  # quantities that the table of main effects has for each output
_LONGEST = 120  # letters of a status that a table shows
_ROWS, _COLUMNS = 4, 4  # panels of a figure of main effects
_PANELS = 12  # of a figure of distributions
_SPREAD = ("n_folds", "n_solved")  # counts whose distribution is worth a panel
_ANSWERS, _MOST_ANSWERS = ("verdict", "effects"), 12
_DRAWN = 5  # quantities along which failures are drawn

DISTRIBUTIONS = (
    "Distribution of the outputs over the members that have them; their number is given above a "
    "panel where some have none. Lines are the median and, dotted, the ends "
    "of the 95 % range, members beyond the range of frequencies "
    "included; the outermost thousandth on either side is counted in the "
    "last bars."
)
EFFECTS = (
    "Each output (rows) against each varied quantity (columns). Dots are some of the members, "
    "lines the mean of all members with that value, with its 95 % band; members without a value "
    "are in neither. Above a panel: the fraction of the output's variance due to the quantity "
    "alone. Scatter of the dots about the line is due to the other quantities."
)
BANDS = (
    "Curves of the members: median, 95 % and all of those that have a curve at each abscissa. "
    "Where a response folds, it has several values at a frequency; the highest and the lowest are "
    "drawn separately. Bands end "
    "where fewer than nine tenths of all members have a curve: the rest would not be "
    "representative."
)
FAILED = (
    "Members without a complete result: over the two quantities in which they differ most from "
    "the others, and the fraction that failed along each quantity, with its 95 % interval."
)


def write_study_report(folder: Path, data: "xarray.Dataset") -> StudyDigest:
    """Write summary.csv, main_effects.csv, the figures (PNG) and report.html of a study.

    Returns the study's numbers.
    """
    study = digest(data)
    _write_table(folder / "summary.csv", summary_frame(study.summaries))
    effects = effects_frame(study)
    if len(effects):
        _write_table(folder / "main_effects.csv", effects)
    sections = (
        _distributions(folder, study),
        _effects(folder, study),
        _bands(folder, data),
        _answers(folder, data),
        _failures(folder, study, data),
    )
    stated = {
        "computed": data.attrs.get("computed"),
        "velocities at": study.sensor,
        "members": study.n_members,
        "sampling": study.sampling,
        "varied": ", ".join(study.quantities),
        **{name: data.attrs.get(f"{name}_version") for name in ("snrmjax", "jax", "numpy")},
    }
    report = Report(
        title=f"Study: {data.attrs.get('title', 'study')}",
        done=[(name, str(value)) for name, value in stated.items() if value],
        result=study_sentence(study),
        notes=[str(fact) for fact in study.facts],
        sections=[section for section in sections if section is not None],
    )
    write_report(folder / "report.html", report)
    return study


def members_ended(study: StudyDigest) -> str:
    """The number of members without a complete result, by kind of failure, in one sentence."""
    failures = study.failures
    if not failures.n_failed:
        return f"{study.n_members} members, all with a complete result."
    each = ", ".join(f"{count} {name}" for name, count in failures.failed_kinds)
    return (
        f"{study.n_members} members, of which {failures.n_failed} have no complete result: {each}."
    )


def study_sentence(study: StudyDigest) -> str:
    """The result of a study in one or two plain sentences."""
    if not study.effects:
        return members_ended(study)
    last, effects = study.effects[0].outputs[-1], study.effects[0].effects[-1]  # the largest force
    (row,) = (
        s for s in study.summaries if (s.scalar.name, s.scalar.force) == (last.name, last.force)
    )
    shown = display(np.array([row.least, row.most]), last.unit)
    title, unit = readable(last.name, last.force), f" {shown.unit}" if shown.unit else ""
    median, wide = _median_and_range(row)
    whose = "the members"
    if row.missing:
        title, whose = f"{title} of {of_members(row.described, row.members)}", "these"
    text = f"{title}: median {median}{unit}, 95 % of {whose} {wide}{unit}"
    order = ranked_effects(effects)
    if order:
        name, one = order[0]
        text += f"; {name} alone causes {100 * max(one.fraction, 0.0):.0f} % of its variance"
        if last.n_known < row.members:
            text += f" over the {last.n_known} members with a value"
    return f"{members_ended(study)} {text}."


def summary_table(rows: Sequence[ScalarSummary], caption: str) -> ReportTable:
    """Of each output: mean, deviation, median, 95 % range, extremes."""
    header = ("output", "unit", "members", "mean ± 1σ", "median", "95 % range", "min to max")
    return ReportTable(header, [_cells(row) for row in rows], caption)


def _cells(row: ScalarSummary) -> tuple[str, ...]:
    ends = np.array([row.least, row.most])
    shown = display(ends, row.scalar.unit)
    title = readable(row.scalar.name, row.scalar.force)
    members = str(row.members) if not row.missing else f"{row.described} of {row.members}"
    if not row.described:
        return (title, shown.unit, members, "", "", "", "")
    sides = ((row.below, -np.inf), (row.above, np.inf))
    beyond = [f"{n} {span_in_words(end, ends=row.scalar.ends)}" for n, end in sides if n]
    mean = f"{number(row.mean / shown.size)} ± {number(row.std / shown.size, 2)}"
    extremes = span_in_words(row.least, row.most, ends=row.scalar.ends, shown=shown)
    return (
        *(title, shown.unit, ", ".join([members, *beyond])),
        *("" if row.outside else mean, *_median_and_range(row), extremes),
    )


def _median_and_range(row: ScalarSummary) -> tuple[str, str]:
    """Median and 95 % range of an output, in the unit in which its table shows it."""
    shown = display(np.array([row.least, row.most]), row.scalar.unit)
    low, _, median, _, high = row.quantiles.tolist()
    spans = [
        span_in_words(*values, ends=row.scalar.ends, shown=shown)
        for values in ((median,), (low, high))
    ]
    return spans[0], spans[1]


def _effects_table(study: StudyDigest) -> ReportTable:
    """The most influential quantities of every output, and the variance due to none alone."""

    def cell(name: str, one: MainEffect) -> str:
        return f"{name}: {100 * max(one.fraction, 0.0):.0f} ± {100 * one.half_width:.0f} %"

    rows = []
    for output, effects in study.each_effect:
        order = ranked_effects(effects)
        if order:
            rest = 1.0 - sum(max(one.fraction, 0.0) for _, one in order)
            cells = [cell(*pair) for pair in order[:_RANKS]]
            cells += [""] * (_RANKS - len(cells))
            title = readable(output.name, output.force)
            rows.append(
                (
                    title,
                    of_members(output.n_known, study.n_members),
                    *cells,
                    f"{100 * max(rest, 0.0):.0f} %",
                )
            )
    return ReportTable(
        ("output", "of", *(f"{k + 1}." for k in range(_RANKS)), "not by one alone"),
        rows,
        "Fraction of the output's variance due to each quantity alone (first-order index, ± 95 %), "
        "largest first. The last column is due to interactions and, in tests, to noise. Fractions "
        "refer to the members that have a value; all of them are in main_effects.csv.",
    )


def _status_table(study: StudyDigest, data: "xarray.Dataset") -> ReportTable:
    """How many members ended in which way."""
    counts = study.failures.counts
    fraction = 100 / sum(counts.values())
    rows = [
        (
            *(short_name(name, _LONGEST), str(count), f"{fraction * count:.3g} %"),
            "yes" if name in COMPLETE else "no",
        )
        for name, count in counts.items()
    ]
    each = "members and forces" if FORCE in data["status"].dims else "members"
    header = ("status", each, "fraction", "complete")
    return ReportTable(header, rows, "How the computations ended.")


def _write_table(file: Path, table: "pandas.DataFrame") -> None:
    write_atomically(file, table.to_csv(index=False, lineterminator="\n"))


def _saved(folder: Path, name: str, figure: Figure, caption: str) -> ReportFigure:
    done = printed(figure)
    write_atomically(folder / f"{name}.png", done.png)
    return ReportFigure(done, caption)


def _distributions(folder: Path, study: StudyDigest) -> Section:
    shown = [
        output
        for output in study.outputs
        if (output[0].name in _SPREAD or not output[0].is_count)
        and any(one.varies for one in output)
    ]
    figures = []
    for k in range(0, len(shown), _PANELS):
        name = "distributions" if len(shown) <= _PANELS else f"distributions_{k // _PANELS + 1}"
        figure = distributions_figure(shown[k : k + _PANELS])
        figures.append(_saved(folder, name, figure, DISTRIBUTIONS))
    caption = (
        "The outputs over the members that have them, see the column of members; where a value is "
        "known to lie outside the computed range, the member counts on that side. Further "
        "quantiles are in summary.csv."
    )
    rows = [
        row
        for row in study.summaries
        if not row.scalar.is_count or (row.varies and row.scalar.name in _SPREAD)
    ]
    return Section("Distributions", (), figures, [summary_table(rows, caption)])


def _effects(folder: Path, study: StudyDigest) -> Section | None:
    if not study.quantities or not study.effects:
        return None
    figures = []
    for k in range(0, len(study.effects), _ROWS):
        shown = study.effects[k : k + _ROWS]
        strongest: dict[str, float] = dict.fromkeys(study.quantities, 0.0)
        for one in (effects for panel in shown for effects in panel.effects):
            for name, effect in ranked_effects(one):
                strongest[name] = max(strongest[name], effect.fraction)
        names = sorted(strongest, key=lambda name: -strongest[name])[:_COLUMNS]
        several = len(study.effects) > _ROWS
        name = f"main_effects_{k // _ROWS + 1}" if several else "main_effects"
        drawn = {name: study.quantities[name] for name in names}
        figure = main_effects_figure(shown, drawn, study.units)
        figures.append(_saved(folder, name, figure, EFFECTS))
    table = _effects_table(study)
    tables = [table] if table.rows else []
    return Section("Main effects", (), figures, tables)


def _bands(folder: Path, data: "xarray.Dataset") -> Section | None:
    shown = curve_bands(data)
    if not shown:
        return None
    caption = BANDS
    if data.sizes[MEMBER] > SAMPLED:
        caption += f" Medians and 95 % are those of {SAMPLED} members, drawn at random."
    return Section("Bands", (), [_saved(folder, "bands", bands_figure(shown), caption)])


def _answers(folder: Path, data: "xarray.Dataset") -> Section | None:
    """How often a diagnosis gave which answer."""
    names = [name for name in _ANSWERS if name in data]
    if not names:
        return None
    answered = np.isin(data["status"].values.astype(str), COMPLETE)
    counts = [
        (name.capitalize(), dict(Counter(given.tolist()).most_common()))
        for name, given in ((name, data[name].values.astype(str)[answered]) for name in names)
    ]
    drawn = [(name, dict(list(answers.items())[:_MOST_ANSWERS])) for name, answers in counts]
    n, whose = int(answered.sum()), of_members(int(answered.sum()), data.sizes[MEMBER])
    tables = [
        ReportTable(
            (name.lower(), "members", "fraction"),
            [(text or "none", str(k), f"{100 * k / n:.3g} %") for text, k in answers.items()],
            f"Of {whose}: those with an answer." if n < data.sizes[MEMBER] else "",
            folded=f"All answers: {name.lower()}",
        )
        for name, answers in counts
    ]
    caption = f"How often each answer was given: {whose}."
    figures = [_saved(folder, "answers", counts_figure(drawn), caption)]
    return Section("Answers", (), figures, tables)


def _failures(folder: Path, study: StudyDigest, data: "xarray.Dataset") -> Section:
    table = _status_table(study, data)
    if not study.failures.n_failed:
        return Section("Failures", ("Every member has a complete result.",), (), [table])
    text = f"{study.failures.n_failed} of {study.n_members} members have no complete result."
    if not study.quantities:
        return Section("Failures", (text,), (), [table])
    names = ranked_by_failure(study.quantities, study.failures.failed)[:_DRAWN]
    drawn = {name: study.quantities[name] for name in names}
    figure = failures_figure(study.failures, drawn, study.units)
    return Section("Failures", (text,), [_saved(folder, "failures", figure, FAILED)], [table])
