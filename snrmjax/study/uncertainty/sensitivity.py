"""Variance-based sensitivity of a study's outputs: main effects and Sobol' indices.

The first-order index S = Var(E[y | x])/Var(y) is the average relative reduction of the variance of
the output y if x were known. `main_effect` estimates it from any sample, as the variance of a
regression curve; `sobol_indices` from the pairs of Saltelli's scheme, together with the total
index, which a curve cannot give.
"""

import json
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, quantity, setting
from snrmjax.numerics.rules import InputError

if TYPE_CHECKING:
    import xarray

FEWEST = 50  # members for an estimate of fractions
_FEW_VALUES = 12  # up to this number of distinct values each has its own mean
_PIECES, _MEMBERS_A_PIECE = 7, 64
_DEGREE = 3
_GROUPS = 20  # of the jackknife
_SHOWN = 101
_RESAMPLES = 200
_FEWEST_ROWS = 16
_NORMAL_95 = 1.959964  # half width of the 95 % interval, in 1σ


class MainEffect(NamedTuple):
    """Main effect of one varied quantity on an output."""

    fraction: float  # first-order index
    half_width: float  # of its 95 % interval
    at: Float[np.ndarray, " point"]  # values of the quantity
    mean: Float[np.ndarray, " point"]  # conditional mean of the output
    error: Float[np.ndarray, " point"]  # half width of the 95 % band of that mean


class SobolIndices(AbstractResult):
    """Fractions of an output's variance by quantity: alone (first), with interactions (total).

    Quantities that vary together are one input. Half widths are of 95 % intervals, by bootstrap.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("quantity", "input")

    units: tuple[str, ...] = eqx.field(static=True)
    first: Float[np.ndarray, "quantity input"] = quantity(
        "quantity input", "1", "first-order index"
    )
    first_half_width: Float[np.ndarray, "quantity input"] = quantity(
        "quantity input", "1", "half width of the 95 % interval"
    )
    total: Float[np.ndarray, "quantity input"] = quantity("quantity input", "1", "total index")
    total_half_width: Float[np.ndarray, "quantity input"] = quantity(
        "quantity input", "1", "half width of the 95 % interval"
    )
    variance: Float[np.ndarray, " quantity"] = quantity("quantity", "SI", "variance")
    rows: np.ndarray = quantity("quantity", "1", "rows of Saltelli's scheme used")
    n_rows: int = setting()  # of the scheme
    names: tuple[str, ...] = quantity("quantity", "", "output", name="quantity", static=True)
    input_names: tuple[str, ...] = quantity(
        "input", "", "varied quantity", name="input", static=True
    )
    notes: tuple[Fact, ...] = setting()

    def summary(self) -> tuple[str, ...]:
        """Inputs of every quantity, ranked by their total index."""
        lines = [f"Sobol' indices of {len(self.names)} quantities"]
        for q, name in enumerate(self.names):
            head = f"{name}: {np.sqrt(self.variance[q]):.3g} {self.units[q]} (1σ)"
            part = f", of {self.rows[q]} of {self.n_rows} rows"
            lines.append(head + (part if self.rows[q] < self.n_rows else ""))
            for k in np.argsort(-self.total[q]).tolist():
                lines.append(
                    f"  {self.input_names[k]}: first {self.first[q, k]:.3f} ±"
                    f" {self.first_half_width[q, k]:.3f}, total {self.total[q, k]:.3f} ±"
                    f" {self.total_half_width[q, k]:.3f} (95 %)"
                )
        return (*lines, *(f"note: {note}" for note in self.notes))


def main_effect(
    quantity: Float[np.ndarray, " member"], output: Float[np.ndarray, " member"]
) -> MainEffect | None:
    """Fraction of variance and conditional mean of an output over one quantity.

    The conditional mean is a cubic regression spline, or the mean at each value where the quantity
    takes few. Members without an output are left out. The fraction is corrected for the degrees of
    freedom of the curve (adjusted R²), its interval is by jackknife over twenty groups of members.
    Returns None with fewer than `FEWEST` members, or where one of the two does not vary.
    """
    known = np.isfinite(output) & np.isfinite(quantity)
    x, y = quantity[known], output[known]
    if len(y) < FEWEST or not np.ptp(x) > 0 or not np.ptp(y) > 0:
        return None
    values = np.unique(x)
    listed = len(values) <= _FEW_VALUES
    low, high = np.quantile(x, [0.005, 0.995]).tolist()
    at = values if listed else np.linspace(low, high, _SHOWN)
    knots = values if listed else _knots(x)
    basis = _levels if listed else _splines
    scale = y.std()
    centred = (y - y.mean()) / scale
    # Normal equations by groups: products of basis, output and one, summed over members.
    table = np.column_stack([basis(x, knots), centred, np.ones(len(y))])
    groups = [table[k::_GROUPS].T @ table[k::_GROUPS] for k in range(_GROUPS)]
    total = np.sum(groups, axis=0)
    coefficients, covariance, fraction = _fit(total)
    without = np.array([_fit(total - group)[2] for group in groups])
    std = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((without - without.mean()) ** 2))
    rows = basis(at, knots)
    error = np.sqrt(np.maximum(np.sum((rows @ covariance) * rows, axis=1), 0.0))
    mean = y.mean() + scale * (rows @ coefficients)
    return MainEffect(fraction, _NORMAL_95 * float(std), at, mean, _NORMAL_95 * scale * error)


def correlated_pairs(quantities: dict[str, Float[np.ndarray, " member"]]) -> list[tuple[str, str]]:
    """Varied quantities with correlated ranks, whose fractions overlap."""
    from scipy.stats import rankdata

    names = [name for name, values in quantities.items() if np.ptp(values) > 0]
    if len(names) < 2 or len(quantities[names[0]]) < FEWEST:
        return []
    ranks = np.array([rankdata(quantities[name]) for name in names])
    limit = max(0.1, 4 / np.sqrt(ranks.shape[1]))
    alike = np.abs(np.corrcoef(ranks)) > limit
    return [(names[i], names[j]) for i, j in zip(*np.nonzero(np.triu(alike, 1)), strict=True)]


def sobol_indices(data: "xarray.Dataset", *, seed: int = 0) -> SobolIndices:
    """First-order and total Sobol' indices of a study's outputs, with 95 % intervals.

    S_i = Var(E[f | x_i])/Var(f) is the fraction of the variance due to input i alone; the total
    index T_i = E[Var(f | all but x_i)]/Var(f) includes its interactions. A row of Saltelli's scheme
    with a member without value is left out.

    Arguments: `data` of a study whose sampling is "saltelli", by `open_study`; `seed` of the
    bootstrap. Returns `SobolIndices` of every scalar output (for each force); NaN for one that does
    not vary or has few complete rows.
    Raises `ValueError` for a study with another sampling.
    Reference: Saltelli et al., Comput. Phys. Commun. 181 (2010) 259,
    doi:10.1016/j.cpc.2009.09.018.
    """
    study = json.loads(data.attrs["study"])["study"]
    method = study["sampling"]["method"]
    if method != "saltelli":
        raise InputError(
            "Sobol' indices need the members of Saltelli's scheme, but the study's sampling is "
            f'{method}: use method = "saltelli".'
        )
    inputs = [", ".join(one["names"]) for one in study["variations"]]
    columns, units = _outputs(data)
    a_row = len(inputs) + 2
    indices, variance, rows = [], [], []
    for values in columns.values():
        table = values.reshape(-1, a_row)
        kept = table[np.isfinite(table).all(axis=1)]
        rows.append(len(kept))
        variance.append(float(np.var(kept)) if len(kept) else np.nan)
        known = len(kept) >= _FEWEST_ROWS and variance[-1] > 0
        indices.append(_indices(kept, seed) if known else np.full((4, len(inputs)), np.nan))
    missing = 1 - a_row * np.array(rows) / data.sizes["member"]
    first, first_half_width, total, total_half_width = np.stack(indices, axis=1)
    return SobolIndices(
        first=first,
        first_half_width=first_half_width,
        total=total,
        total_half_width=total_half_width,
        variance=np.array(variance),
        rows=np.array(rows),
        n_rows=data.sizes["member"] // a_row,
        names=tuple(columns),
        input_names=tuple(inputs),
        units=units,
        notes=tuple(
            Fact("rows_without_value", output=name, fraction=fraction)
            for name, fraction in zip(columns, missing.tolist(), strict=True)
            if fraction > 0
        ),
    )


def _outputs(data: "xarray.Dataset") -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Scalar outputs, separately for each force, and their units."""
    columns, units = {}, []
    for name, one in data.data_vars.items():
        if one.dtype.kind != "f" or one.dims not in (("member",), ("member", "force_n")):
            continue
        several = [""] if one.ndim == 1 else [f" at {f:g} N" for f in data["force_n"].values]
        for text, values in zip(several, one.values.reshape(len(one), -1).T, strict=True):
            columns[f"{name}{text}"] = values
            units.append(str(one.attrs.get("units", "")))
    return columns, tuple(units)


def _indices(values: Float[np.ndarray, "row member"], seed: int) -> Float[np.ndarray, "4 input"]:
    """First and total indices, each followed by its half width by the bootstrap over rows."""

    def of(rows: np.ndarray) -> np.ndarray:
        base, mixed, other = rows[..., :1], rows[..., 1:-1], rows[..., -1:]
        variance = np.var(np.concatenate([base, other], axis=-2), axis=-2)
        first = np.mean(other * (mixed - base), axis=-2) / variance
        return np.stack([first, np.mean((base - mixed) ** 2, axis=-2) / (2 * variance)])

    # Centred to avoid cancellation in the product of the first index.
    centred = values - values.mean()
    drawn = np.random.default_rng(seed + 1).integers(len(values), size=(_RESAMPLES, len(values)))
    with np.errstate(invalid="ignore"):  # a resample may have no variance
        half_width = _NORMAL_95 * np.nanstd(of(centred[drawn]), axis=1, ddof=1)
    return np.stack([of(centred), half_width], axis=1).reshape(4, -1)


def _fit(sums: Float[np.ndarray, "sum sum"]) -> tuple[np.ndarray, np.ndarray, float]:
    """Coefficients, their covariance and the adjusted R²; zero where there are no members."""
    basis, with_output, n = sums[:-2, :-2], sums[:-2, -2], sums[-1, -1]
    inverse = np.linalg.pinv(basis, rcond=1e-10, hermitian=True)
    coefficients = inverse @ with_output
    residual = max(sums[-2, -2] - coefficients @ with_output, 0.0) / max(n - len(coefficients), 1)
    variance = (sums[-2, -2] - sums[-2, -1] ** 2 / n) / (n - 1)
    return coefficients, inverse * residual, float(1.0 - residual / variance)


def _knots(x: Float[np.ndarray, " member"]) -> Float[np.ndarray, " knot"]:
    """Knots of a clamped spline with equally many members per piece."""
    pieces = int(np.clip(len(x) // _MEMBERS_A_PIECE, 1, _PIECES))
    inner = np.unique(np.quantile(x, np.linspace(0, 1, pieces + 1)))
    return np.concatenate([[inner[0]] * _DEGREE, inner, [inner[-1]] * _DEGREE])


def _splines(
    x: Float[np.ndarray, " member"], knots: Float[np.ndarray, " knot"]
) -> Float[np.ndarray, "member basis"]:
    from scipy.interpolate import BSpline

    return BSpline.design_matrix(x, knots, _DEGREE).toarray()


def _levels(
    x: Float[np.ndarray, " member"], values: Float[np.ndarray, " value"]
) -> Float[np.ndarray, "member value"]:
    return (x[:, None] == values[None, :]).astype(np.float64)
