"""Which uncertain inputs make a quantity uncertain: Sobol' indices and bounds by derivatives."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.study.uncertainty.moments import sobol_members
from snrmjax.study.uncertainty.quantities import AbstractQuantities, MemberStatus

_RESAMPLES = 200
_FEW = 0.05  # share of the members beyond which what is left out is worth a note


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
            **_labels(self.names, self.input_names),
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


class DerivativeBounds(AbstractResult):
    """Mean squared derivatives, and what they say at most of the total Sobol' index."""

    coordinates: ClassVar[tuple[str, ...]] = ("quantity", "input")

    mean_square: Float[np.ndarray, "quantity input"]  # E[(∂f/∂input)²], SI
    bound: Float[np.ndarray, "quantity input"]  # on the total index
    bound_std: Float[np.ndarray, "quantity input"]  # 1σ, by independent scramblings
    variance: Float[np.ndarray, " quantity"]
    found: np.ndarray  # members of each quantity
    names: tuple[str, ...] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """Bounds of every quantity, the largest first."""
        lines = [f"derivative-based sensitivity of {len(self.names)} quantities"]
        for q, name in enumerate(self.names):
            lines.append(f"{name}: {int(self.found[q])} members")
            lines += [
                f"  {self.input_names[k]}: total index at most {self.bound[q, k]:.3f} ±"
                f" {self.bound_std[q, k]:.3f} (1σ)"
                for k in np.argsort(-self.bound[q]).tolist()
            ]
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """Mean squared derivatives and bounds, by quantity and input."""
        at = ("quantity", "input")
        return {
            **_labels(self.names, self.input_names),
            "mean_square": Variable(at, self.mean_square, "SI", "mean squared derivative"),
            "bound": Variable(at, self.bound, "1", "upper bound on the total Sobol' index"),
            "bound_std": Variable(at, self.bound_std, "1", "1σ of the bound"),
            "variance": Variable(("quantity",), self.variance, "SI", "variance"),
            "found": Variable(("quantity",), self.found, "1", "members used"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The notes."""
        return {"notes": "\n".join(self.notes)}


def sobol_indices(
    quantities: AbstractQuantities, *, base_rows: int = 512, seed: int = 0
) -> SobolIndices:
    """First-order and total Sobol' indices by Saltelli's scheme, with 95 % intervals (SALib).

    S_i = Var(E[f | x_i])/Var(f) is the share of the variance that input i makes by itself; the
    total index T_i = E[Var(f | all but x_i)]/Var(f) has its interactions too. They come from
    `base_rows` · (inputs + 2) members; a base row of which one member has no value is left out
    whole.

    Arguments: `base_rows`, a power of two.
    Returns `SobolIndices`; NaN for a quantity that does not vary or of which few rows are left.
    Raises `ValueError` for correlated inputs, for which these indices are not defined, and for
    another number of rows; `ImportError` without SALib: pip install 'snrmjax[sensitivity]'.
    Reference: Saltelli et al., Comput. Phys. Commun. 181 (2010) 259,
    doi:10.1016/j.cpc.2009.09.018.
    """
    sample, analyze = _salib()
    inputs = quantities.inputs
    _check_independent(quantities, "Sobol' indices are")
    if base_rows < 16 or base_rows & (base_rows - 1):
        raise ValueError(f"`base_rows` must be a power of two from 16 on, but is {base_rows}.")
    n = len(inputs.names)
    problem = {
        "num_vars": n,
        "names": list(inputs.names),
        "bounds": [[0.0, 1.0]] * n,  # mean and standard deviation
        "dists": ["norm"] * n,
    }
    z = sample.sample(
        problem, base_rows, calc_second_order=False, seed=np.random.default_rng([seed, 2])
    )
    found = quantities.members(z)
    blocks = found.values.reshape(base_rows, n + 2, -1)
    every = np.full((4, len(quantities.names), n), np.nan)
    rows, variance = [], []
    for q in range(len(quantities.names)):
        whole = np.all(np.isfinite(blocks[:, :, q]), axis=1)
        values = blocks[whole][:, :, q]
        rows.append(int(whole.sum()))
        variance.append(float(np.var(values)) if whole.any() else np.nan)
        if rows[-1] >= 16 and variance[-1] > 0:
            # SALib takes a seed of zero for none.
            indices = analyze.analyze(
                problem,
                values.ravel(),
                calc_second_order=False,
                num_resamples=_RESAMPLES,
                seed=seed + 1,
            )
            every[:, q] = [indices[key] for key in ("S1", "S1_conf", "ST", "ST_conf")]
    return SobolIndices(
        first=every[0],
        first_half_width=every[1],
        total=every[2],
        total_half_width=every[3],
        variance=np.array(variance),
        rows=np.array(rows),
        names=tuple(quantities.names),
        input_names=inputs.names,
        units=tuple(quantities.units),
        base_rows=base_rows,
        notes=tuple(_left_out(quantities.names, 1 - np.array(rows) / base_rows, "base rows")),
    )


def derivative_bounds(
    quantities: AbstractQuantities, *, members: int = 512, seed: int = 0
) -> DerivativeBounds:
    """Derivative-based global sensitivity: T_i ≤ C_i E[(∂f/∂x_i)²]/Var(f), by exact derivatives.

    C is the Poincaré constant of the input's distribution: its variance for a normal one,
    (width/π)² for a uniform one; for a lognormal one derivative and variance are those of its
    logarithm. Far cheaper than Sobol' indices with many inputs: the number of members does
    not grow with them. An input with a bound near zero may be held at its nominal value.

    Arguments: `members`, eight times a power of two.
    Returns `DerivativeBounds`. Raises `ValueError` for correlated inputs and another number.
    Reference: Sobol' & Kucherenko, Math. Comput. Simul. 79 (2009) 3009,
    doi:10.1016/j.matcom.2009.01.023; Lamboni et al., ibid. 87 (2013) 45,
    doi:10.1016/j.matcom.2013.02.002.
    """
    _check_independent(quantities, "these bounds are")
    inputs, scramblings = quantities.inputs, 8
    each, rest = divmod(members, scramblings)
    if each < 8 or rest or each & (each - 1):
        raise ValueError(f"`members` must be 8 times a power of two from 64 on, not {members}.")
    z = sobol_members(each, len(inputs.names), scramblings, seed).reshape(members, -1)
    found, slopes = quantities.gradients(z)
    weight, rate = _weights(quantities, z)
    weighted = (slopes * weight[:, None, :]) ** 2
    variance = np.nanvar(found.values, axis=0)
    pairs = zip(np.split(weighted, scramblings), np.split(found.values, scramblings), strict=True)
    parts = [_over_variance(a, b) for a, b in pairs]
    n_found = np.sum(found.status == int(MemberStatus.FOUND), axis=0)
    return DerivativeBounds(
        mean_square=np.nanmean((slopes / rate[:, None, :]) ** 2, axis=0),
        bound=_over_variance(weighted, found.values),
        bound_std=np.std(parts, axis=0, ddof=1) / np.sqrt(scramblings),
        variance=variance,
        found=n_found,
        names=tuple(quantities.names),
        input_names=inputs.names,
        notes=tuple(_left_out(quantities.names, 1 - n_found / members, "members")),
    )


def _over_variance(squares: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean squares over the quantities' variance; NaN for a quantity that does not vary."""
    variance = np.nanvar(values, axis=0)[:, None]
    mean = np.nanmean(squares, axis=0)
    return np.divide(mean, variance, out=np.full(mean.shape, np.nan), where=variance > 0)


def _weights(quantities: AbstractQuantities, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every member and input √C dz/dy and dx/dz: y is what the Poincaré constant C is of."""
    from scipy import stats

    inputs = quantities.inputs
    kind, density = np.array(inputs.marginals), stats.norm.pdf(z)
    values = np.asarray(jax.vmap(inputs.values)(jnp.asarray(z)))
    own = np.diag(inputs.factor)
    rate = np.where(kind == "lognormal", own * values, own)
    rate = np.where(kind == "uniform", 2 * np.sqrt(3) * inputs.std * density, rate)
    return np.where(kind == "uniform", 1 / (np.pi * density), 1.0), rate


def _check_independent(quantities: AbstractQuantities, what: str) -> None:
    if not quantities.inputs.independent:
        raise ValueError(f"{what} defined for independent inputs only, but these are correlated.")


def _labels(names: tuple[str, ...], input_names: tuple[str, ...]) -> dict[str, Variable]:
    return {
        "quantity": Variable(("quantity",), np.array(names), "", "quantity"),
        "input": Variable(("input",), np.array(input_names), "", "uncertain input"),
    }


def _left_out(names: tuple[str, ...], shares: np.ndarray, of: str) -> list[str]:
    return [
        f"{name}: {100 * share:.2g} % of the {of} are left out, because there it does not exist:"
        " these are the numbers of the others"
        for name, share in zip(names, shares.tolist(), strict=True)
        if share > _FEW
    ]


def _salib() -> tuple[Any, Any]:
    try:
        from SALib.analyze import sobol as analyze
        from SALib.sample import sobol as sample
    except ImportError as error:
        raise ImportError(
            "Sobol' indices need SALib, which is not installed: pip install 'snrmjax[sensitivity]'."
        ) from error
    return sample, analyze
