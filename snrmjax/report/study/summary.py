"""The table of a study's outputs: means, deviations and quantiles over the members."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from snrmjax.report.html import ReportTable, number
from snrmjax.report.study.scalars import Scalar, display

QUANTILES = (2.5, 25.0, 50.0, 75.0, 97.5)  # per cent


class ScalarSummary(NamedTuple):
    """How one output is distributed over the members; NaN where no member has a value."""

    scalar: Scalar  # without its values
    members: int
    missing: int  # members without a value
    mean: float
    std: float
    least: float
    quantiles: Float[np.ndarray, " quantile"]
    most: float

    @property
    def varies(self) -> bool:
        """Whether its members differ by more than rounding."""
        return self.most - self.least > 1e-12 * max(abs(self.most), abs(self.least))


def summarized(scalar: Scalar) -> ScalarSummary:
    """The summary of one output. Standard deviations are of a sample (n - 1)."""
    found = scalar.values[np.isfinite(scalar.values)]
    n, bare = len(scalar.values), scalar._replace(values=np.zeros(0))
    if not found.size:
        none = np.full(len(QUANTILES), np.nan)
        return ScalarSummary(bare, n, n, np.nan, np.nan, np.nan, none, np.nan)
    std = float(np.std(found, ddof=1)) if found.size > 1 else np.nan
    ends = float(found.min()), float(found.max())
    quantiles = np.percentile(found, QUANTILES)
    mean = float(found.mean())
    return ScalarSummary(bare, n, n - found.size, mean, std, ends[0], quantiles, ends[1])


def summary_frame(rows: Iterable[ScalarSummary]) -> pd.DataFrame:
    """The table as summary.csv has it, in the units of the data set."""
    table = []
    for row in rows:
        force = {} if row.scalar.force is None else {"force_n": row.scalar.force}
        named = {f"{q:g}%": v for q, v in zip(QUANTILES, row.quantiles, strict=True)}
        table.append(
            {
                "variable": row.scalar.name,
                **force,
                "unit": row.scalar.unit,
                "members": row.members,
                "without_value": row.missing,
                "mean": row.mean,
                "std": row.std,
                "min": row.least,
                **named,
                "max": row.most,
                "meaning": row.scalar.meaning,
            }
        )
    return pd.DataFrame(table)


def summary_table(rows: Sequence[ScalarSummary], caption: str) -> ReportTable:
    """The table as the report shows it: mean, deviation, median, 95 % range, extremes."""
    header = ("output", "unit", "mean ± 1σ", "median", "95 % range", "min to max", "without value")
    return ReportTable(header, [_cells(row) for row in rows], caption)


def _cells(row: ScalarSummary) -> tuple[str, ...]:
    ends = np.array([row.least, row.most])
    shown = display(ends, row.scalar.unit)
    low, _, median, _, high = row.quantiles / shown.size
    least, most = ends / shown.size
    if row.missing == row.members:
        return (row.scalar.title, shown.unit, "", "", "", "", f"all {row.members}")
    return (
        row.scalar.title,
        shown.unit,
        f"{number(row.mean / shown.size)} ± {number(row.std / shown.size, 2)}",
        number(median),
        f"{number(low)} to {number(high)}",
        f"{number(least)} to {number(most)}",
        str(row.missing) if row.missing else "",
    )
