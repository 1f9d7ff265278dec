"""Which uncertain inputs make a quantity uncertain: Sobol' indices."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import stats

from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.study.uncertainty.quantities import AbstractQuantities
from snrmjax.study.variations import standard_normal

_RESAMPLES = 200
_FEWEST_ROWS = 16
_FEW = 0.05  # share of the rows beyond which what is left out is worth a note


class SobolIndices(AbstractResult):
    """Shares of a quantity's variance by input: alone (first) and with interactions (total)."""

    coordinates: ClassVar[tuple[str, ...]] = ("quantity", "input")

    first: Float[np.ndarray, "quantity input"]
    first_half_width: Float[np.ndarray, "quantity input"]  # of the 95 % interval, by bootstrap
    total: Float[np.ndarray, "quantity input"]
    total_half_width: Float[np.ndarray, "quantity input"]
    variance: Float[np.ndarray, " quantity"]
    rows: np.ndarray  # base rows used of each quantity
    names: tuple[str, ...] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    base_rows: int = eqx.field(static=True)  # that were asked for
    notes: tuple[str, ...] = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """Inputs of every quantity by their total index."""
        n = self.base_rows * (len(self.input_names) + 2)
        lines = [f"Sobol' indices of {len(self.names)} quantities from {n} members"]
        for q, name in enumerate(self.names):
            lines.append(f"{name}: {np.sqrt(self.variance[q]):.3g} {self.units[q]} (1σ)")
            for k in np.argsort(-self.total[q]).tolist():
                lines.append(
                    f"  {self.input_names[k]}: first {self.first[q, k]:.3f} ±"
                    f" {self.first_half_width[q, k]:.3f}, total {self.total[q, k]:.3f} ±"
                    f" {self.total_half_width[q, k]:.3f} (95 %)"
                )
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """Indices with their 95 % intervals, by quantity and input."""
        at, text = ("quantity", "input"), "half width of the 95 % interval"
        return {
            "quantity": Variable(("quantity",), np.array(self.names), "", "quantity"),
            "input": Variable(("input",), np.array(self.input_names), "", "uncertain input"),
            "first": Variable(at, self.first, "1", "first-order index"),
            "first_half_width": Variable(at, self.first_half_width, "1", text),
            "total": Variable(at, self.total, "1", "total index"),
            "total_half_width": Variable(at, self.total_half_width, "1", text),
            "variance": Variable(("quantity",), self.variance, "SI", "variance"),
            "rows": Variable(("quantity",), self.rows, "1", "base rows used"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The notes."""
        return {"notes": "\n".join(self.notes)}


def sobol_indices(
    quantities: AbstractQuantities, *, base_rows: int = 512, seed: int = 0
) -> SobolIndices:
    """First-order and total Sobol' indices by Saltelli's scheme, with 95 % intervals.

    S_i = Var(E[f | x_i])/Var(f) is the share of the variance that input i makes by itself; the
    total index T_i = E[Var(f | all but x_i)]/Var(f) has its interactions too. They come from
    `base_rows` · (inputs + 2) members; a base row of which one member has no value is left out
    whole.

    Arguments: `base_rows`, a power of two.
    Returns `SobolIndices`; NaN for a quantity that does not vary or of which few rows are left.
    Raises `ValueError` for correlated inputs, for which these indices are not defined, and for
    another number of rows.
    Reference: Saltelli et al., Comput. Phys. Commun. 181 (2010) 259,
    doi:10.1016/j.cpc.2009.09.018.
    """
    inputs, names = quantities.inputs, quantities.names
    if not inputs.independent:
        raise ValueError(
            "Sobol' indices are defined for independent inputs only, but these are correlated."
        )
    if base_rows < _FEWEST_ROWS or base_rows & (base_rows - 1):
        raise ValueError(
            f"`base_rows` must be a power of two from {_FEWEST_ROWS} on, but is {base_rows}."
        )
    n = len(inputs.names)
    sequence = stats.qmc.Sobol(2 * n, rng=np.random.default_rng([seed, 2]))
    own, other = np.split(standard_normal(sequence.random(base_rows)), 2, axis=1)
    swapped = np.where(np.eye(n, dtype=bool), other[:, None], own[:, None])
    z = np.concatenate([own[:, None], swapped, other[:, None]], axis=1)
    found = quantities.members(z.reshape(-1, n)).values.reshape(base_rows, n + 2, -1)
    every = np.full((4, len(names), n), np.nan)
    whole = np.isfinite(found).all(axis=1)
    variance = np.full(len(names), np.nan)
    for q, kept in enumerate(whole.T):
        values = found[kept, :, q]
        if kept.any():
            variance[q] = np.var(values)
        if kept.sum() >= _FEWEST_ROWS and variance[q] > 0:
            every[:, q] = _indices(values, seed)
    rows = whole.sum(axis=0)
    return SobolIndices(
        *every,
        variance=variance,
        rows=rows,
        names=tuple(names),
        input_names=inputs.names,
        units=tuple(quantities.units),
        base_rows=base_rows,
        notes=tuple(
            f"{name}: {100 * share:.2g} % of the base rows are left out, because there it does not"
            " exist: these are the numbers of the others"
            for name, share in zip(names, (1 - rows / base_rows).tolist(), strict=True)
            if share > _FEW
        ),
    )


def _indices(values: Float[np.ndarray, "row member"], seed: int) -> Float[np.ndarray, "4 input"]:
    """First and total indices, each with its half width by the bootstrap over rows."""

    def of(rows: np.ndarray) -> np.ndarray:
        own, mixed, other = rows[..., :1], rows[..., 1:-1], rows[..., -1:]
        variance = np.var(np.concatenate([own, other], axis=-2), axis=-2)
        first = np.mean(other * (mixed - own), axis=-2) / variance
        return np.stack([first, np.mean((own - mixed) ** 2, axis=-2) / (2 * variance)])

    # Centred: the product of the first index loses digits to a mean.
    centred = values - values.mean()
    drawn = np.random.default_rng(seed + 1).integers(len(values), size=(_RESAMPLES, len(values)))
    with np.errstate(invalid="ignore"):  # rows drawn again and again may not vary
        spread = np.nanstd(of(centred[drawn]), axis=1, ddof=1)
    half_width = stats.norm.ppf(0.975) * spread
    return np.stack([of(centred), half_width], axis=1).reshape(4, -1)
