"""What a report says of a study: its outputs, their summaries and main effects, its failures."""

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from snrmjax.report.html import ReportTable
from snrmjax.report.study.failures import Failures, failures_of, range_notes
from snrmjax.report.study.main_effects import FEWEST, MainEffect, correlated_pairs, main_effect
from snrmjax.report.study.scalars import Scalar, scalars, varied_quantities, varied_unit
from snrmjax.report.study.study_figures import EffectPanels
from snrmjax.report.study.summary import ScalarSummary, summarized

if TYPE_CHECKING:
    import xarray

_RANKS = 3  # quantities that the table of main effects has for each output
_UNSURE = 0.1  # half width of a share from which it is called uncertain
_OVERLAP = 0.02  # by which shares may add up to more than one


class StudyDigest(NamedTuple):
    """A study in numbers."""

    quantities: dict[str, Float[np.ndarray, " member"]]
    units: dict[str, str]  # of the quantities
    outputs: list[list[Scalar]]  # each for every force
    summaries: list[ScalarSummary]
    effects: list[EffectPanels]  # of the outputs that vary
    failures: Failures

    @property
    def n_members(self) -> int:
        """How many members there are."""
        return len(self.failures.failed)

    @property
    def estimated(self) -> bool:
        """Whether there is any main effect."""
        return any(one for panel in self.effects for each in panel.effects for one in each.values())

    @property
    def headline(self) -> str:
        """How many members failed, or have no peak in the range, in one sentence."""
        n, outside = self.n_members, self.failures.n_outside
        failed = self.failures.n_failed - outside
        text = f"{n} members, " + (f"of which {failed} failed" if failed else "none failed")
        return text + (f"; {outside} have no peak in the range." if outside else ".")


def output_summaries(data: "xarray.Dataset") -> list[ScalarSummary]:
    """The summaries of a data set's outputs alone."""
    return [summarized(one) for one in scalars(data)]


def digest(data: "xarray.Dataset") -> StudyDigest:
    """The numbers of a study's data set; outputs are read one after another."""
    quantities = {k: v for k, v in varied_quantities(data).items() if np.ptp(v) > 0}
    outputs = [list(group) for _, group in groupby(scalars(data), key=lambda one: one.name)]
    effects = []
    for output in outputs:
        if output[0].is_count or not any(one.varies for one in output):
            continue
        each = [
            {name: main_effect(x, one.values) for name, x in quantities.items()} for one in output
        ]
        effects.append(EffectPanels(output, each))
    return StudyDigest(
        quantities=quantities,
        units={name: varied_unit(data, name) for name in quantities},
        outputs=outputs,
        summaries=[summarized(one) for output in outputs for one in output],
        effects=effects,
        failures=failures_of(data),
    )


def ranked_effects(effects: dict[str, MainEffect | None]) -> list[tuple[str, MainEffect]]:
    """The quantities by their share of the variance, the largest first."""
    found = [(name, one) for name, one in effects.items() if one is not None]
    return sorted(found, key=lambda pair: -pair[1].share)


def effects_frame(shown: Sequence[EffectPanels]) -> pd.DataFrame:
    """All shares of variance, as main_effects.csv has them."""
    rows = []
    for output, effects in _each(shown):
        force = {} if output.force is None else {"force_n": output.force}
        rows += [
            {
                "variable": output.name,
                **force,
                "varied": name,
                "first_order_share": one.share,
                "half_width_95": one.half_width,
            }
            for name, one in ranked_effects(effects)
        ]
    return pd.DataFrame(rows)


def effects_table(shown: Sequence[EffectPanels]) -> ReportTable:
    """The strongest quantities of every output, and what none of them explains alone."""
    header = ("output", *(f"{k + 1}." for k in range(_RANKS)), "not by one alone")
    rows = []
    for output, effects in _each(shown):
        order = ranked_effects(effects)
        if not order:
            continue
        cells = [f"{name}: {_per_cent(one)}" for name, one in order[:_RANKS]]
        rest = 1.0 - sum(max(one.share, 0.0) for _, one in order)
        filled = cells + [""] * (_RANKS - len(cells))
        rows.append((output.title, *filled, f"{100 * max(rest, 0.0):.0f} %"))
    return ReportTable(
        header,
        rows,
        "Share of the output's variance that each quantity makes alone (first-order index, ± 95 %),"
        " the strongest first. The last column is left to interactions and, in tests, to noise. "
        "All shares are in main_effects.csv.",
    )


def digest_notes(found: StudyDigest, data: "xarray.Dataset") -> list[str]:
    """What a reader of the numbers should know."""
    return [
        *_on_sampling(found, data),
        *_on_shares(found),
        *_on_missing(found),
        *range_notes(found.failures),
    ]


def _on_sampling(found: StudyDigest, data: "xarray.Dataset") -> list[str]:
    method = sampling_method(data)
    if method not in ("grid", "list"):
        return []
    return [
        f"the members are a {method} of chosen values: means, ranges and shares describe these "
        "members, each as important as the others, not a probability"
    ]


def sampling_method(data: "xarray.Dataset") -> str:
    """How the members were chosen; empty where the data set does not say."""
    import json

    described = json.loads(data.attrs.get("study", "{}"))
    return str(described.get("study", {}).get("sampling", {}).get("method", ""))


def _on_shares(found: StudyDigest) -> list[str]:
    if not found.quantities or not found.effects:
        return []
    each = [(out, one) for out, effects in _each(found.effects) for one in effects.values()]
    notes = []
    few = sorted({out.title for out, one in each if one is None and out.varies})
    if few:
        notes.append(f"too few members (fewer than {FEWEST}) for shares of variance: {_some(few)}")
    unsure = sorted({o.title for o, one in each if one is not None and one.half_width > _UNSURE})
    if unsure:
        notes.append(
            f"shares of variance are uncertain by more than {100 * _UNSURE:.0f} % of the variance "
            f"for {_some(unsure)}: more members would tell"
        )
    pairs = correlated_pairs(found.quantities)
    if pairs:
        words = [f"{a} and {b}" for a, b in pairs]
        notes.append(
            f"{_some(words)} vary together: their shares of variance overlap and may add up to "
            "more than the whole"
        )
    elif any(_sum(effects) > 1 + _OVERLAP for _, effects in _each(found.effects)):
        notes.append("shares of variance add up to more than one by their errors")
    return notes


def _sum(effects: dict[str, MainEffect | None]) -> float:
    known = [one for one in effects.values() if one is not None]
    return sum(one.share - one.half_width for one in known)


def _on_missing(found: StudyDigest) -> list[str]:
    notes = []
    missing = [s for s in found.summaries if s.missing]
    if missing:
        words = [f"{s.scalar.title} ({s.missing} of {s.members})" for s in missing]
        notes.append(f"members without a value are left out: {_some(words)}")
    lost = [s for s in found.summaries if s.scalar.name == "n_not_located" and s.most > 0]
    if lost:
        notes.append(
            "in some responses an event (fold, peak or resonance) is there but was not located: "
            "see n_not_located"
        )
    return notes


def _some(words: Sequence[str], most: int = 4) -> str:
    further = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + further


def _per_cent(one: MainEffect) -> str:
    return f"{100 * max(one.share, 0.0):.0f} ± {100 * one.half_width:.0f} %"


def _each(
    shown: Sequence[EffectPanels],
) -> list[tuple[Scalar, dict[str, MainEffect | None]]]:
    return [pair for one in shown for pair in zip(one.outputs, one.effects, strict=True)]
