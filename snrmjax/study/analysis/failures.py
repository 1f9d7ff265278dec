"""Failed members of a study: by status, and over the varied quantities."""

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.numerics.facts import Fact
from snrmjax.study.computations.base import COMPLETE, PEAK_SIDE, MemberStatus

if TYPE_CHECKING:
    import xarray

_BINS = 10


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
