"""What a study's data set has one number of for every member, and how it is distributed."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from snrmjax.study.computations.base import FORCE, MEMBER
from snrmjax.study.computations.tests import SHARE

if TYPE_CHECKING:
    import xarray

QUANTILES = (2.5, 25.0, 50.0, 75.0, 97.5)  # per cent
_ENDS = ((0, "smallest"), (-1, "largest"))
_ROUNDING = 1e-12  # relative differences that are none


class Scalar(NamedTuple):
    """One number of every member, NaN where a member has none."""

    name: str  # of the variable
    unit: str
    meaning: str
    values: Float[np.ndarray, " member"]
    force: float | None = None  # N, where members are computed for several forces

    @property
    def is_count(self) -> bool:
        """Whether it counts something, such as folds or points."""
        return self.name.startswith(("n_", "first_"))

    @property
    def varies(self) -> bool:
        """Whether at least two members differ by more than rounding."""
        known = self.values[np.isfinite(self.values)]
        return known.size > 1 and bool(np.ptp(known) > _ROUNDING * np.max(np.abs(known)))


class ScalarSummary(NamedTuple):
    """How one output is distributed over the members; NaN where no member has a value."""

    scalar: Scalar  # without its values
    varies: bool
    members: int
    missing: int  # members without a value
    mean: float
    std: float  # of a sample: n - 1
    least: float
    quantiles: Float[np.ndarray, " quantile"]
    most: float


def summarized(scalar: Scalar) -> ScalarSummary:
    """The distribution of one output."""
    n, known = len(scalar.values), scalar.values[np.isfinite(scalar.values)]
    whole = known if known.size else np.array([np.nan])
    return ScalarSummary(
        scalar=scalar._replace(values=np.zeros(0)),
        varies=scalar.varies,
        members=n,
        missing=n - known.size,
        mean=float(whole.mean()),
        std=float(np.std(known, ddof=1)) if known.size > 1 else np.nan,
        least=float(whole.min()),
        quantiles=np.percentile(whole, QUANTILES),
        most=float(whole.max()),
    )


def summary_frame(rows: Iterable[ScalarSummary]) -> pd.DataFrame:
    """The table that is summary.csv, in the units of the data set."""
    return pd.DataFrame(
        {
            "variable": row.scalar.name,
            **({} if row.scalar.force is None else {"force_n": row.scalar.force}),
            "unit": row.scalar.unit,
            "members": row.members,
            "without_value": row.missing,
            "mean": row.mean,
            "std": row.std,
            "min": row.least,
            **{f"{q:g}%": v for q, v in zip(QUANTILES, row.quantiles, strict=True)},
            "max": row.most,
            "meaning": row.scalar.meaning,
        }
        for row in rows
    )


def varied_quantities(data: "xarray.Dataset") -> dict[str, Float[np.ndarray, " member"]]:
    """Values of every quantity that is stated for the members, by name."""
    return {
        str(name): np.asarray(one.values, dtype=np.float64)
        for name, one in data.coords.items()
        if one.dims == (MEMBER,) and name != MEMBER
    }


def scalars(data: "xarray.Dataset") -> Iterator[Scalar]:
    """Every output that is one number a member, one at a time, and one for each force.

    Beside the variables over `member` alone: the lowest and the highest frequency of a fold, and
    identified curves at the smallest and the largest amplitude.
    """
    for key, variable in data.data_vars.items():
        name = str(key)
        if variable.dtype.kind not in "fi" or name.startswith("first_"):
            continue
        meaning, unit = variable.attrs.get("long_name", ""), variable.attrs.get("units", "")
        if variable.dims in ((MEMBER,), (MEMBER, FORCE)):
            yield from _by_force(data, name, unit, meaning, variable.values)
        elif variable.dims == (MEMBER, SHARE):
            for k, which in _ENDS:
                words = f"{meaning}, at the {which} amplitude"
                values = variable[:, k].values
                yield from _by_force(data, f"{name}_at_{which}_amplitude", unit, words, values)
    if "fold_frequency_hz" in data:
        folds = data["fold_frequency_hz"].values
        has, first = data["n_folds"].values > 0, data["first_fold"].values
        for which, reduce in (("lowest", np.fmin), ("highest", np.fmax)):
            values = np.full(has.shape, np.nan)
            if has.any():  # rows are in the order of members: one's end is the next one's beginning
                values[has] = reduce.reduceat(folds, first[has])
            text = f"{which} frequency at which the response folds"
            yield from _by_force(data, f"{which}_fold_frequency_hz", "Hz", text, values)


def _by_force(
    data: "xarray.Dataset", name: str, unit: str, meaning: str, values: np.ndarray
) -> Iterator[Scalar]:
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.ndim == 1:
        yield Scalar(name, unit, meaning, numbers)
        return
    for force, column in zip(data[FORCE].values.tolist(), numbers.T, strict=True):
        yield Scalar(name, unit, meaning, column, force)
