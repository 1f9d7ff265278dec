"""Scalar outputs of a study's data set, and their distributions."""

import json
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from snrmjax.numerics.units import HERTZ
from snrmjax.study.computations.base import FORCE, MEMBER, PEAK_SIDE
from snrmjax.study.computations.tests import FRACTION

if TYPE_CHECKING:
    import xarray

QUANTILES = (2.5, 25.0, 50.0, 75.0, 97.5)  # per cent
_ENDS = ((0, "smallest"), (-1, "largest"))
_OF_THE_PEAK = ("peak_frequency_hz", "resonance_frequency_hz")
_ROUNDING = 1e-12  # relative differences due to rounding


class Scalar(NamedTuple):
    """A scalar output of every member, NaN where a member has none.

    A frequency known to be below or above the computed range is -inf or inf.
    """

    name: str  # of the variable
    unit: str
    meaning: str
    values: Float[np.ndarray, " member"]
    force: float | None = None  # N, where members are computed for several forces
    ends: tuple[float, float] = (-np.inf, np.inf)  # of the range, in the same unit

    @property
    def n_known(self) -> int:
        """Number of members with a value."""
        return int(np.isfinite(self.values).sum())

    @property
    def is_count(self) -> bool:
        """Whether it is a count, such as of folds or points."""
        return self.name.startswith(("n_", "first_"))

    @property
    def varies(self) -> bool:
        """Whether at least two members differ by more than rounding."""
        known = self.values[np.isfinite(self.values)]
        return known.size > 1 and bool(np.ptp(known) > _ROUNDING * np.max(np.abs(known)))


class ScalarSummary(NamedTuple):
    """Distribution of one output over the members that have it.

    Members whose value is known to be below or above the computed range are included: quantiles
    and extremes are -inf or inf there, and the mean is unknown. NaN where no member has a value.
    """

    scalar: Scalar  # without its values
    varies: bool
    members: int
    missing: int  # members without a value, not included below
    below: int  # members below the range
    above: int
    mean: float
    std: float  # of a sample: n - 1
    least: float
    quantiles: Float[np.ndarray, " quantile"]
    most: float

    @property
    def described(self) -> int:
        """Number of members in the distribution."""
        return self.members - self.missing

    @property
    def outside(self) -> int:
        """Number of members with a value outside the computed range."""
        return self.below + self.above


def summarized(scalar: Scalar) -> ScalarSummary:
    """The distribution of one output."""
    n, known = len(scalar.values), scalar.values[~np.isnan(scalar.values)]
    below, above = int(np.sum(known == -np.inf)), int(np.sum(known == np.inf))
    whole = known if known.size else np.array([np.nan])
    whole_range = not (below or above)
    return ScalarSummary(
        scalar=scalar._replace(values=np.zeros(0)),
        varies=scalar.varies,
        members=n,
        missing=n - known.size,
        below=below,
        above=above,
        mean=float(whole.mean()) if whole_range else np.nan,
        std=float(np.std(known, ddof=1)) if whole_range and known.size > 1 else np.nan,
        least=float(whole.min()),
        quantiles=_quantiles(whole),
        most=float(whole.max()),
    )


def _quantiles(values: Float[np.ndarray, " member"]) -> Float[np.ndarray, " quantile"]:
    """Linear interpolation between members, or the nearest one where one of two is infinite."""
    finite = values[np.isfinite(values)]
    if finite.size == values.size:
        return np.percentile(values, QUANTILES)
    nearest = np.percentile(values, QUANTILES, method="nearest")
    if not finite.size:
        return nearest
    between = np.percentile(np.clip(values, finite.min(), finite.max()), QUANTILES)
    around = [np.percentile(values, QUANTILES, method=m) for m in ("lower", "higher")]
    return np.where(np.isfinite(around).all(axis=0), between, nearest)


def summary_frame(rows: Iterable[ScalarSummary]) -> pd.DataFrame:
    """The table summary.csv, in the units of the data set.

    Statistics exclude the members `without_value`; -inf and inf are below and above the computed
    range.
    """
    return pd.DataFrame(
        {
            "variable": row.scalar.name,
            **({} if row.scalar.force is None else {"force_n": row.scalar.force}),
            "unit": row.scalar.unit,
            "members": row.members,
            "without_value": row.missing,
            "below_range": row.below,
            "above_range": row.above,
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
    """Values of every varied quantity, by name."""
    return {
        str(name): np.asarray(one.values, dtype=np.float64)
        for name, one in data.coords.items()
        if one.dims == (MEMBER,) and name != MEMBER
    }


def scalars(data: "xarray.Dataset") -> Iterator[Scalar]:
    """Every scalar output, separately for each force.

    In addition to the variables over `member`: the lowest and the highest frequency of a fold, and
    identified curves at the smallest and the largest amplitude.
    """
    for key, variable in data.data_vars.items():
        name = str(key)
        if variable.dtype.kind not in "fi" or name.startswith("first_") or name == PEAK_SIDE:
            continue
        meaning, unit = variable.attrs.get("long_name", ""), variable.attrs.get("units", "")
        if name in _OF_THE_PEAK and PEAK_SIDE in data:
            side = data[PEAK_SIDE].values
            values = variable.values
            values = np.where(np.isnan(values) & (side != 0), np.copysign(np.inf, side), values)
            yield from _by_force(data, name, unit, meaning, values, range_of(data))
        elif variable.dims in ((MEMBER,), (MEMBER, FORCE)):
            yield from _by_force(data, name, unit, meaning, variable.values)
        elif variable.dims == (MEMBER, FRACTION):
            for k, which in _ENDS:
                words = f"{meaning}, at the {which} amplitude"
                values = variable[:, k].values
                yield from _by_force(data, f"{name}_at_{which}_amplitude", unit, words, values)
    if "fold_frequency_hz" in data:
        folds = data["fold_frequency_hz"].values
        has, first = data["n_folds"].values > 0, data["first_fold"].values
        for which, reduce, end in (("lowest", np.fmin, -1), ("highest", np.fmax, 1)):
            values = np.full(has.shape, np.nan)
            if has.any():  # rows are in the order of members, as `reduceat` needs
                values[has] = reduce.reduceat(folds, first[has])
            text, ends = f"{which} frequency at which the response folds", {}
            if PEAK_SIDE in data:
                # An odd number of folds: the range ends between two, and one of them is outside.
                beyond = (data["n_folds"].values % 2 == 1) & (data[PEAK_SIDE].values == end)
                values, ends = np.where(beyond, end * np.inf, values), {"ends": range_of(data)}
            yield from _by_force(data, f"{which}_fold_frequency_hz", "Hz", text, values, **ends)


def range_of(data: "xarray.Dataset") -> tuple[float, float]:
    """The ends of the frequency range of a study of responses, in Hz."""
    within = json.loads(data.attrs["study"])["study"]["computation"]["within"]
    return within["from_frequency"] / HERTZ, within["to_frequency"] / HERTZ


def _by_force(
    data: "xarray.Dataset",
    name: str,
    unit: str,
    meaning: str,
    values: np.ndarray,
    ends: tuple[float, float] = (-np.inf, np.inf),
) -> Iterator[Scalar]:
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.ndim == 1:
        yield Scalar(name, unit, meaning, numbers, ends=ends)
        return
    for force, column in zip(data[FORCE].values.tolist(), numbers.T, strict=True):
        yield Scalar(name, unit, meaning, column, force, ends)
