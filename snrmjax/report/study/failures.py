"""Where members of a study failed: by status, and in the space of what varies."""

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.report.html import ReportTable
from snrmjax.study.computations.base import COMPLETE, FORCE, HIGHEST_AT_END, NO_PEAK

if TYPE_CHECKING:
    import xarray

_BINS = 10
_LONGEST = 120  # letters of a status that a table shows


class Failures(NamedTuple):
    """How the members ended. A member with several forces failed if it failed for one of them."""

    counts: dict[str, int]  # by status, of all members and forces
    failed: Bool[np.ndarray, " member"]
    status: np.ndarray  # of each member: the first that is no success, or its own

    @property
    def n_failed(self) -> int:
        """How many members failed."""
        return int(self.failed.sum())

    @property
    def kinds(self) -> list[str]:
        """The statuses of failed members, the most frequent first."""
        return list(self.failed_counts)

    @property
    def failed_counts(self) -> dict[str, int]:
        """How many members failed with each status, the most frequent first."""
        return dict(Counter(self.status[self.failed].tolist()).most_common())

    @property
    def n_outside(self) -> int:
        """How many members were computed but have their resonance outside the range."""
        return sum(self.failed_counts.get(name, 0) for name in (NO_PEAK, HIGHEST_AT_END))


class FailureShare(NamedTuple):
    """Share of members that failed over equally populated parts of one varied quantity."""

    edges: Float[np.ndarray, " edge"]
    share: Float[np.ndarray, " part"]
    low: Float[np.ndarray, " part"]  # of the 95 % interval (Wilson)
    high: Float[np.ndarray, " part"]


def failures_of(data: "xarray.Dataset") -> Failures:
    """How the members of a data set ended."""
    status = data["status"].values.astype(str)
    rows = status.reshape(len(status), -1)
    bad = np.asarray(~np.isin(rows, COMPLETE))
    worst = rows[np.arange(len(rows)), np.argmax(bad, axis=1)]
    counts = Counter(status.ravel().tolist())
    return Failures(dict(counts.most_common()), np.any(bad, axis=1), worst)


def range_notes(failures: Failures) -> list[str]:
    """What to do about members whose resonance is not in the range of a study of peaks."""
    counts, notes = failures.failed_counts, []
    if NO_PEAK in counts:
        notes.append(
            f"{counts[NO_PEAK]} members have no peak between `from_hz` and `to_hz` (status "
            f"{NO_PEAK}): their response is highest at an end of the range; widen it"
        )
    if HIGHEST_AT_END in counts:
        notes.append(
            f"the response of {counts[HIGHEST_AT_END]} members is higher at an end of the range "
            f"than at its highest peak (status {HIGHEST_AT_END}): widen the range to have that "
            "resonance, or narrow it to leave the other resonance out"
        )
    return notes


def failure_share(
    quantity: Float[np.ndarray, " member"], failed: Bool[np.ndarray, " member"]
) -> FailureShare:
    """Share of failed members along one quantity, with 95 % intervals (Wilson)."""
    from scipy.stats import binomtest

    edges = np.unique(np.quantile(quantity, np.linspace(0, 1, _BINS + 1)))
    part = np.clip(np.searchsorted(edges, quantity, side="right") - 1, 0, max(len(edges) - 2, 0))
    n = np.bincount(part, minlength=len(edges) - 1)
    k = np.bincount(part, weights=failed, minlength=len(edges) - 1).astype(int)
    ends = [
        binomtest(int(a), int(b)).proportion_ci(method="wilson") if b else (np.nan, np.nan)
        for a, b in zip(k, n, strict=True)
    ]
    low, high = np.array(ends).T
    return FailureShare(edges, np.where(n > 0, k / np.maximum(n, 1), np.nan), low, high)


def most_telling(
    quantities: dict[str, Float[np.ndarray, " member"]], failed: Bool[np.ndarray, " member"]
) -> list[str]:
    """Names of what varies, first those whose values differ most between failed and whole members.

    By the Kolmogorov–Smirnov distance of the two groups.
    """
    from scipy.stats import ks_2samp

    if failed.all() or not failed.any():
        return list(quantities)
    distance = {
        name: ks_2samp(values[failed], values[~failed], method="asymp").statistic
        for name, values in quantities.items()
    }
    return sorted(distance, key=lambda name: -distance[name])


def status_table(failures: Failures, data: "xarray.Dataset") -> ReportTable:
    """How many members ended in which way."""
    total = sum(failures.counts.values())
    rows = [
        (
            name if len(name) <= _LONGEST else f"{name[:_LONGEST]} …",
            str(count),
            f"{100 * count / total:.3g} %",
            "yes" if name in COMPLETE else "no",
        )
        for name, count in failures.counts.items()
    ]
    each = "members and forces" if FORCE in data["status"].dims else "members"
    header = ("status", each, "share", "complete")
    return ReportTable(header, rows, "How the computations ended.")
