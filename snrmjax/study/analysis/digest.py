"""A study in numbers: its outputs, their distributions and main effects, its failures."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from snrmjax.numerics.facts import Fact
from snrmjax.study.analysis.outputs import (
    Scalar,
    ScalarSummary,
    scalars,
    summarized,
    varied_quantities,
)
from snrmjax.study.computations.base import COMPLETE, PEAK_SIDE, MemberStatus
from snrmjax.study.uncertainty.sensitivity import (
    FEWEST,
    MainEffect,
    correlated_pairs,
    main_effect,
)

if TYPE_CHECKING:
    import xarray

_BINS = 10
if TYPE_CHECKING:
    import xarray

_UNSURE = 0.1  # half width from which a fraction is reported as uncertain
_OVERLAP = 0.02  # tolerated excess of the sum of fractions over one

Effects = dict[str, MainEffect | None]  # by quantity; None where there are too few members


class Failures(NamedTuple):
    """Statuses of the members. A member fails if it fails for one of its forces."""

    counts: dict[str, int]  # by status, of all members and forces
    failed: Bool[np.ndarray, " member"]
    status: np.ndarray  # of each member: its first failure, else its success
    below: int  # members whose only peak is known to be below the frequency range
    above: int

    @property
    def n_failed(self) -> int:
        """Number of failed members."""
        return int(self.failed.sum())

    @property
    def failed_counts(self) -> dict[str, int]:
        """Number of failed members by status, the most frequent first."""
        return dict(Counter(self.status[self.failed].tolist()).most_common())

    @property
    def failed_kinds(self) -> tuple[tuple[str, int], ...]:
        """Number of failed members by status name, without reasons."""
        kinds = (name.partition(":")[0] for name in self.status[self.failed].tolist())
        return tuple(Counter(kinds).most_common())

    @property
    def facts(self) -> tuple[Fact, ...]:
        """Notes on members whose resonance is outside the range of a study of peaks."""
        facts, counts = [], self.failed_counts
        if MemberStatus.NO_PEAK in counts:
            n_members = counts[MemberStatus.NO_PEAK]
            sides = {"below": self.below, "above": self.above}
            facts.append(Fact("no_peak_in_range", n_members=n_members, **sides))
        if MemberStatus.HIGHEST_AT_END in counts:
            n_members = counts[MemberStatus.HIGHEST_AT_END]
            facts.append(Fact("highest_at_range_end", n_members=n_members))
        if MemberStatus.PEAK_NOT_LOCATED in counts:
            n_members = counts[MemberStatus.PEAK_NOT_LOCATED]
            facts.append(Fact("peak_not_located", n_members=n_members))
        return tuple(facts)


class FailureFraction(NamedTuple):
    """Fraction of failed members in equally populated bins of one varied quantity."""

    edges: Float[np.ndarray, " edge"]
    fraction: Float[np.ndarray, " part"]
    low: Float[np.ndarray, " part"]  # of the 95 % interval (Wilson)
    high: Float[np.ndarray, " part"]


def failures_of(data: "xarray.Dataset") -> Failures:
    """Statuses of the members of a data set."""
    status = data["status"].values.astype(str)
    rows = status.reshape(len(status), -1)
    bad = np.asarray(~np.isin(rows, COMPLETE))
    worst = rows[np.arange(len(rows)), np.argmax(bad, axis=1)]
    counts = Counter(status.ravel().tolist())
    side = data[PEAK_SIDE].values if PEAK_SIDE in data else np.zeros(status.shape)
    below, above = (int(np.sum((s * side > 0).reshape(len(rows), -1).any(axis=1))) for s in (-1, 1))
    return Failures(dict(counts.most_common()), np.any(bad, axis=1), worst, below, above)


def failure_fraction(
    quantity: Float[np.ndarray, " member"], failed: Bool[np.ndarray, " member"]
) -> FailureFraction:
    """Fraction of failed members over one quantity, with 95 % intervals (Wilson)."""
    from scipy.stats import binomtest

    edges = np.unique(np.quantile(quantity, np.linspace(0, 1, _BINS + 1)))
    n = np.histogram(quantity, edges)[0]
    k = np.histogram(quantity[failed], edges)[0]
    ends = [
        binomtest(int(a), int(b)).proportion_ci(method="wilson") if b else (np.nan, np.nan)
        for a, b in zip(k, n, strict=True)
    ]
    low, high = np.array(ends).T
    return FailureFraction(edges, np.where(n > 0, k / np.maximum(n, 1), np.nan), low, high)


def ranked_by_failure(
    quantities: dict[str, Float[np.ndarray, " member"]], failed: Bool[np.ndarray, " member"]
) -> list[str]:
    """Names of the varied quantities by how well they separate failed from successful members.

    Ranked by the Kolmogorov–Smirnov distance of the two groups.
    """
    from scipy.stats import ks_2samp

    if failed.all() or not failed.any():
        return list(quantities)
    distance = {
        name: ks_2samp(values[failed], values[~failed], method="asymp").statistic
        for name, values in quantities.items()
    }
    return sorted(distance, key=lambda name: -distance[name])


class OutputEffects(NamedTuple):
    """One output, for every force, and its main effects."""

    outputs: Sequence[Scalar]
    effects: Sequence[Effects]


class StudyDigest(NamedTuple):
    """A study in numbers."""

    quantities: dict[str, Float[np.ndarray, " member"]]  # those that vary
    units: dict[str, str]  # of the quantities
    outputs: list[list[Scalar]]  # each for every force
    summaries: list[ScalarSummary]
    effects: list[OutputEffects]  # of the outputs that vary
    failures: Failures
    sampling: str  # sampling method; empty if not in the data set
    sensor: str  # of peaks and velocities; empty likewise

    @property
    def n_members(self) -> int:
        """Number of members."""
        return len(self.failures.failed)

    @property
    def each_effect(self) -> Iterator[tuple[Scalar, Effects]]:
        """Every output and force with its effects."""
        for effect in self.effects:
            yield from zip(effect.outputs, effect.effects, strict=True)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """Notes on the numbers."""
        facts = []
        if self.sampling in ("grid", "list"):
            facts.append(Fact("members_chosen", method=self.sampling))
        if self.quantities and self.effects:
            facts += self._on_fractions()
        missing = [s for s in self.summaries if s.missing]
        for s in (s for s in self.summaries if s.outside):
            sides = {"ends": s.scalar.ends, "below": s.below, "above": s.above}
            named = {"output": _named(s.scalar), "members": s.described}
            facts.append(Fact("values_outside", **named, **sides))
        if missing:
            counts = tuple((*_named(s.scalar), s.missing, s.members) for s in missing)
            facts.append(Fact("values_missing", outputs=counts))
        if any(s.scalar.name == "n_not_located" and s.most > 0 for s in self.summaries):
            facts.append(Fact("events_not_located"))
        return (*facts, *self.failures.facts)

    def _on_fractions(self) -> list[Fact]:
        pairs = [(out, effect) for out, effects in self.each_effect for effect in effects.values()]
        few = {_named(out) for out, one in pairs if one is None and out.varies}
        unsure = {_named(out) for out, one in pairs if one and one.half_width > _UNSURE}
        facts = []
        if few:
            facts.append(Fact("too_few_for_fractions", fewest=FEWEST, outputs=tuple(sorted(few))))
        if unsure:
            facts.append(Fact("fractions_uncertain", limit=_UNSURE, outputs=tuple(sorted(unsure))))
        pairs_varied = correlated_pairs(self.quantities)
        if pairs_varied:
            facts.append(Fact("varied_together", pairs=tuple(pairs_varied)))
        elif any(_least_sum(effects) > 1 + _OVERLAP for _, effects in self.each_effect):
            facts.append(Fact("fractions_above_one"))
        return facts


def digest(data: "xarray.Dataset") -> StudyDigest:
    """The numbers of a study's data set; outputs are read one after another."""
    quantities = {k: v for k, v in varied_quantities(data).items() if np.ptp(v) > 0}
    outputs = [list(group) for _, group in groupby(scalars(data), key=lambda one: one.name)]
    effects = [
        OutputEffects(
            output,
            [{name: main_effect(x, y.values) for name, x in quantities.items()} for y in output],
        )
        for output in outputs
        if not output[0].is_count and any(one.varies for one in output)
    ]
    described = json.loads(data.attrs.get("study", "{}")).get("study", {})
    return StudyDigest(
        quantities=quantities,
        units={name: str(data[name].attrs.get("units", "")) for name in quantities},
        outputs=outputs,
        summaries=[summarized(one) for output in outputs for one in output],
        effects=effects,
        failures=failures_of(data),
        sampling=str(described.get("sampling", {}).get("method", "")),
        sensor=str(data.attrs.get("sensor", "")),
    )


def ranked_effects(effects: Effects) -> list[tuple[str, MainEffect]]:
    """The quantities by their fraction of the variance, the largest first."""
    known = [(name, one) for name, one in effects.items() if one is not None]
    return sorted(known, key=lambda pair: -pair[1].fraction)


def effects_frame(study: StudyDigest) -> pd.DataFrame:
    """The table main_effects.csv: fractions of variance over members with a value."""
    return pd.DataFrame(
        {
            "variable": output.name,
            **({} if output.force is None else {"force_n": output.force}),
            "members": output.n_known,
            "varied": name,
            "first_order_fraction": one.fraction,
            "half_width_95": one.half_width,
        }
        for output, effects in study.each_effect
        for name, one in ranked_effects(effects)
    )


def _named(scalar: Scalar) -> tuple[str, float | None]:
    return scalar.name, scalar.force


def _least_sum(effects: Effects) -> float:
    """Lower bound of the sum of the fractions."""
    return sum(
        effect.fraction - effect.half_width for effect in effects.values() if effect is not None
    )
