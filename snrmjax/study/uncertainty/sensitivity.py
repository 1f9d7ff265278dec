"""Which varied quantities make a study's outputs vary: Sobol' indices."""

import json
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.numerics.result import AbstractResult, Variable

if TYPE_CHECKING:
    import xarray

_RESAMPLES = 200
_FEWEST_ROWS = 16
_FEW = 0.05  # share of the rows beyond which what is left out is worth a note
_NORMAL_95 = 1.959964  # half width of the 95 % interval, in 1σ


class SobolIndices(AbstractResult):
    """Shares of an output's variance by varied quantity: alone (first), with interactions (total).

    Quantities that vary together are one input.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("quantity", "input")

    first: Float[np.ndarray, "quantity input"]
    first_half_width: Float[np.ndarray, "quantity input"]  # of the 95 % interval, by bootstrap
    total: Float[np.ndarray, "quantity input"]
    total_half_width: Float[np.ndarray, "quantity input"]
    variance: Float[np.ndarray, " quantity"]
    rows: np.ndarray  # of Saltelli's scheme that were used of each quantity
    names: tuple[str, ...] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """Inputs of every quantity by their total index."""
        lines = [f"Sobol' indices of {len(self.names)} quantities"]
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
            "quantity": Variable(("quantity",), np.array(self.names), "", "output"),
            "input": Variable(("input",), np.array(self.input_names), "", "varied quantity"),
            "first": Variable(at, self.first, "1", "first-order index"),
            "first_half_width": Variable(at, self.first_half_width, "1", text),
            "total": Variable(at, self.total, "1", "total index"),
            "total_half_width": Variable(at, self.total_half_width, "1", text),
            "variance": Variable(("quantity",), self.variance, "SI", "variance"),
            "rows": Variable(("quantity",), self.rows, "1", "rows used"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The notes."""
        return {"notes": "\n".join(self.notes)}


def sobol_indices(data: "xarray.Dataset", *, seed: int = 0) -> SobolIndices:
    """First-order and total Sobol' indices of a study's outputs, with 95 % intervals.

    S_i = Var(E[f | x_i])/Var(f) is the share of the variance that input i makes by itself; the
    total index T_i = E[Var(f | all but x_i)]/Var(f) has its interactions too. A row of Saltelli's
    scheme of which one member has no value is left out whole.

    Arguments: `data` of a study whose sampling is "saltelli", by `open_study`; `seed` of the
    bootstrap. Returns `SobolIndices` of every output that is one number a member (and force); NaN
    for one that does not vary or of which few rows are left.
    Raises `ValueError` for a study with another sampling.
    Reference: Saltelli et al., Comput. Phys. Commun. 181 (2010) 259,
    doi:10.1016/j.cpc.2009.09.018.
    """
    study = json.loads(data.attrs["study"])["study"]
    method = study["sampling"]["method"]
    if method != "saltelli":
        raise ValueError(
            "Sobol' indices need the members of Saltelli's scheme, but the study's sampling is "
            f'{method}: take method = "saltelli".'
        )
    inputs = [", ".join(one["names"]) for one in study["variations"]]
    columns, units = _outputs(data)
    a_row = len(inputs) + 2
    every, variance, rows = [], [], []
    for values in columns.values():
        table = values.reshape(-1, a_row)
        kept = table[np.isfinite(table).all(axis=1)]
        rows.append(len(kept))
        variance.append(float(np.var(kept)) if len(kept) else np.nan)
        known = len(kept) >= _FEWEST_ROWS and variance[-1] > 0
        every.append(_indices(kept, seed) if known else np.full((4, len(inputs)), np.nan))
    missing = 1 - a_row * np.array(rows) / data.sizes["member"]
    first, first_half_width, total, total_half_width = np.stack(every, axis=1)
    return SobolIndices(
        first=first,
        first_half_width=first_half_width,
        total=total,
        total_half_width=total_half_width,
        variance=np.array(variance),
        rows=np.array(rows),
        names=tuple(columns),
        input_names=tuple(inputs),
        units=units,
        notes=tuple(
            f"{name}: {100 * share:.2g} % of the rows are left out, because there it does not"
            " exist: these are the numbers of the others"
            for name, share in zip(columns, missing.tolist(), strict=True)
            if share > _FEW
        ),
    )


def _outputs(data: "xarray.Dataset") -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Every output that is a number for each member, or for each member and force, and its unit."""
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
        own, mixed, other = rows[..., :1], rows[..., 1:-1], rows[..., -1:]
        variance = np.var(np.concatenate([own, other], axis=-2), axis=-2)
        first = np.mean(other * (mixed - own), axis=-2) / variance
        return np.stack([first, np.mean((own - mixed) ** 2, axis=-2) / (2 * variance)])

    # Centred: the product of the first index loses digits to a mean.
    centred = values - values.mean()
    drawn = np.random.default_rng(seed + 1).integers(len(values), size=(_RESAMPLES, len(values)))
    with np.errstate(invalid="ignore"):  # rows drawn again and again may not vary
        half_width = _NORMAL_95 * np.nanstd(of(centred[drawn]), axis=1, ddof=1)
    return np.stack([of(centred), half_width], axis=1).reshape(4, -1)
