"""One potential fitted to static load cases: linear least squares over all modal equations."""

import itertools
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.model.potential import Monomial, PolynomialPotential, monomial_key
from snrmjax.numerics.rules import InputError

_NOT_EXCITED = 1e-7  # of a unit column: a monomial that no load case excites
_SINGULAR = 1e11  # condition number of the scaled columns above which coefficients are arbitrary


class FitSystem(NamedTuple):
    """The equations f − ω²q = ∂V/∂q of all cases, scaled: design @ scaled ≈ target.

    Row (c, m) is divided by the typical linear force of mode m, column k multiplied by
    `column_scale`, so that coefficient = scaled × column_scale.
    """

    design: Float[Array, "case mode monomial"]
    target: Float[Array, "case mode"]
    column_scale: Float[Array, " monomial"]
    row_scale: Float[Array, " mode"]  # kg^1/2 m/s²


@lru_cache(maxsize=64)
def monomials_of(n_modes: int, degree: int, lowest: int = 2) -> tuple[Monomial, ...]:
    """Monomials of a potential whose force has degrees from `lowest` to `degree`.

    >>> monomials_of(1, 3), len(monomials_of(4, 3))
    (((0, 0, 0), (0, 0, 0, 0)), 55)
    """
    return tuple(
        modes
        for size in range(lowest + 1, degree + 2)
        for modes in itertools.combinations_with_replacement(range(n_modes), size)
    )


def check_degree(degree: int) -> None:
    """Raises `ValueError` for a degree of the force that is not from 2 to 7."""
    if isinstance(degree, bool) or not isinstance(degree, int) or not 2 <= degree <= 7:
        raise InputError(f"`degree` of the force must be a whole number from 2 to 7, not {degree}.")


def fit_system(
    basis: ReductionBasis, cases: StaticCases, monomials: tuple[Monomial, ...]
) -> FitSystem:
    """The scaled equations of the fit; rows of unusable cases are zero."""
    xp = _namespace(basis, cases)
    force, moved = xp.asarray(cases.force), xp.asarray(cases.modal_displacement)
    finite = xp.isfinite(xp.concatenate([force, moved], axis=1)).all(axis=1)
    used = (xp.asarray(cases.converged) & finite)[:, None]
    q, force = xp.where(used, moved, 0.0), xp.where(used, force, 0.0)
    stiffness = xp.asarray(basis.frequency) ** 2
    typical = xp.sqrt(xp.sum(q**2, axis=0) / xp.sum(used))
    row_scale = stiffness * typical
    n_modes = q.shape[1]
    exponent = np.array([[m.count(i) for i in range(n_modes)] for m in monomials])
    column_scale = xp.mean(row_scale * typical) / xp.prod(typical**exponent, axis=1)
    # ∂/∂q_m of monomial k is n_km times the product of the others: powers of scaled q.
    scaled = q / xp.where(typical > 0, typical, 1.0)
    powers = [xp.ones_like(scaled)]
    for _ in range(int(exponent.max())):
        powers.append(powers[-1] * scaled)
    of_power = xp.stack(powers, axis=-1)  # case, mode, power
    columns = []
    for m in range(n_modes):
        remaining = np.maximum(exponent - (np.arange(n_modes) == m), 0)
        product = xp.prod(of_power[:, np.arange(n_modes), remaining], axis=-1)  # case, monomial
        columns.append(product * exponent[:, m])
    # Scaled so that each modal equation is divided by its `row_scale`.
    per_mode = xp.mean(row_scale * typical) / (row_scale * typical)
    design = xp.stack(columns, axis=1) * per_mode[:, None]
    return FitSystem(design, (force - stiffness * q) / row_scale, column_scale, row_scale)


def fit_potential(
    basis: ReductionBasis, cases: StaticCases, *, degree: int = 3
) -> PolynomialPotential:
    """The potential V whose gradient fits f = ω²q + ∂V/∂q best, in all equations at once.

    Each coefficient of V enters several equations; a common fit keeps them consistent (the force
    is conservative), unlike a fit equation by equation. Equations are weighted by one over the
    typical linear force ω²q of their mode. Solved by a QR decomposition; compatible with `jit` and
    `vmap`, with exact gradients by `basis` and `cases`, and without checks: see `reduced_model`.

    Arguments: `degree` of the force, from 2 to 7.
    Returns the potential, without standard deviations. Cases that did not converge are excluded;
    NaN if the cases do not determine the potential.
    Reference: Hollkamp & Gordon, J. Sound Vib. 318 (2008) 1139, doi:10.1016/j.jsv.2008.04.035.
    """
    check_degree(degree)
    n_modes = cases.force.shape[1]
    monomials = monomials_of(n_modes, degree)
    system = fit_system(basis, cases, monomials)
    coefficient = solve_scaled(system) * system.column_scale
    return PolynomialPotential(coefficient, jnp.zeros(len(monomials)), monomials, n_modes)


def solve_scaled(system: FitSystem) -> Float[Array, " monomial"]:
    """The scaled coefficients of a fit system; NaN if it is singular."""
    rows, target = system.design.reshape(-1, system.design.shape[-1]), system.target.reshape(-1)
    if rows.shape[0] < rows.shape[1]:
        return jnp.full(rows.shape[1], jnp.nan)
    if isinstance(rows, np.ndarray):
        basis, triangle = np.linalg.qr(rows)
        return jnp.asarray(np.linalg.solve(triangle, basis.T @ target))
    solution = lx.linear_solve(lx.MatrixLinearOperator(rows), target, lx.QR(), throw=False)
    return jnp.where(solution.result == lx.RESULTS.successful, solution.value, jnp.nan)


def _namespace(*trees: object) -> Any:
    """NumPy for concrete values, so that nothing is compiled; JAX within `jit` and `grad`."""
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))
    return jnp if traced else np


class LeftOutCases(NamedTuple):
    """Leave-one-case-out residuals and jackknife errors, without refitting."""

    residual: Float[np.ndarray, "case mode"]  # of the fit to all cases, scaled rows
    cross_validated: Float[np.ndarray, "case mode"]  # of each case, for the fit to the others
    std: Float[np.ndarray, " monomial"]  # jackknife 1σ of the scaled coefficients
    condition: float


def leave_out(system: FitSystem) -> LeftOutCases:
    """Leave out each case in turn, in closed form from one decomposition.

    With H = QQᵀ of the design the leave-one-out residual of case c is (I − H_cc)⁻¹ r_c. It is
    infinite for a case without which the others do not determine the potential. Standard
    deviations of the coefficients are those of the jackknife over cases.
    Reference: B. Efron & R. J. Tibshirani, An Introduction to the Bootstrap (1993), ch. 11,
    doi:10.1201/9780429246593.
    """
    design, target = np.asarray(system.design), np.asarray(system.target)
    n_cases, n_modes, n_unknowns = design.shape
    rows = design.reshape(-1, n_unknowns)
    basis, triangle = np.linalg.qr(rows)
    values = np.linalg.solve(triangle, basis.T @ target.reshape(-1))
    residual = target - design @ values
    blocks = basis.reshape(n_cases, n_modes, n_unknowns)
    rest = np.eye(n_modes) - blocks @ blocks.transpose(0, 2, 1)
    indispensable = np.linalg.eigvalsh(rest)[:, 0] < 1e-9
    rest[indispensable] = np.eye(n_modes)
    cross_validated = np.linalg.solve(rest, residual[..., None])[..., 0]
    shift = np.linalg.solve(triangle, np.einsum("cmk,cm->kc", blocks, cross_validated)).T
    std = np.sqrt((n_cases - 1) / n_cases * np.sum((shift - shift.mean(axis=0)) ** 2, axis=0))
    cross_validated[indispensable] = np.inf
    return LeftOutCases(
        residual,
        cross_validated,
        np.full(n_unknowns, np.nan) if indispensable.any() else std,
        float(np.linalg.cond(triangle)),
    )


def require_determined(system: FitSystem, monomials: tuple[Monomial, ...], n_used: int) -> None:
    """Raises `ValueError` if the cases do not determine every coefficient, naming some."""
    rows = np.asarray(system.design).reshape(-1, len(monomials))
    equations = n_used * system.design.shape[1]
    if equations < len(monomials):
        raise InputError(
            f"{n_used} usable load cases give {equations} equations for {len(monomials)} "
            "coefficients: more load cases, or a lower degree, are needed."
        )
    norm = np.linalg.norm(rows, axis=0) / np.sqrt(max(n_used, 1))
    undetermined = [
        monomial_key(m) for m, s in zip(monomials, norm, strict=True) if not s > _NOT_EXCITED
    ]
    if not undetermined:
        values, directions = np.linalg.svd(rows / np.linalg.norm(rows, axis=0))[1:]
        if values[0] < _SINGULAR * values[-1]:
            return
        fraction = np.abs(directions[-1])
        undetermined = [
            monomial_key(monomials[k]) for k in np.flatnonzero(fraction > 0.3 * fraction.max())
        ]
    names = ", ".join(undetermined[:6]) + (", …" if len(undetermined) > 6 else "")
    raise InputError(
        f"the load cases do not determine these coefficients separately: {names} (modes of the "
        "reduced model); combine more modes, add load levels, or lower the degree."
    )
