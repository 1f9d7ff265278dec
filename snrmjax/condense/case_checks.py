"""Plausibility checks of static load cases, individually and together."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.potential_fit import (
    FitSystem,
    LeftOutCases,
    fit_system,
    monomials_of,
    solve_scaled,
)
from snrmjax.model.potential import PolynomialPotential
from snrmjax.numerics.facts import Fact

_GOOD = 0.01  # residual over nonlinear force below which no warning is given
_EXPLAINED = 0.3  # of the residual, left with two more degrees: then the degree was too low
_ROUND_OFF = 1e-9  # residual over linear force below which only round-off is left
_SMALL = 1e-3  # nonlinear over linear force that a table of six digits cannot resolve
_ONE_CASE = 0.01  # of the squared residual, left without the inconsistent cases
_LINEAR = 0.02  # permitted deviation of the linear stiffness from the load cases
_ENERGY = 0.01  # relative, of the strain energy
_UNIT = 5.0  # times the linear displacement, above which a wrong unit is suspected
_SHOWN = 4


class FitView(NamedTuple):
    """A fit for the checks; its rows are those of the usable cases."""

    basis: ReductionBasis
    cases: StaticCases  # the usable ones
    potential: PolynomialPotential
    system: FitSystem
    left_out: LeftOutCases
    degree: int

    @property
    def misfit(self) -> float:
        """Residual over nonlinear force, rms of all scaled equations."""
        return rms(self.left_out.residual) / rms(self.system.target)


def rms(values: np.ndarray | Array) -> float:
    """Root mean square of all numbers."""
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def case_names(cases: StaticCases, rows: np.ndarray | tuple[int, ...]) -> str:
    """Load cases in messages: their names, or their rows counted from one."""
    listed = [cases.names[k] if cases.names else f"row {k + 1}" for k in rows]
    more = f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    return ", ".join(listed[:_SHOWN]) + more


def case_warnings(all_cases: StaticCases, fit: FitView) -> tuple[Fact, ...]:
    """Warnings about the load cases, to be read before the model is used.

    Facts on single cases have their rows in `cases`, and names of the first few.
    Arguments: `all_cases`, including those without a solution.
    """
    used, failed = np.flatnonzero(all_cases.usable), np.flatnonzero(~all_cases.usable)

    def of(rows: np.ndarray) -> dict[str, Any]:
        cases = tuple(int(row) for row in rows)
        return {"cases": cases, "names": case_names(all_cases, cases)}

    warnings = []
    if failed.size:
        warnings.append(Fact("not_converged", n_all=len(all_cases.force), **of(failed)))
    twice = _repeated(np.asarray(all_cases.force)[used])
    if twice:
        warnings.append(Fact("repeated_case", **of(used[list(twice)])))
    inconsistent = _inconsistent(fit)
    if inconsistent.size:
        against, times = _compared_with_linear(fit, inconsistent)
        warnings.append(
            Fact("inconsistent_case", against_force=against, times=times, **of(used[inconsistent]))
        )
    else:
        warnings += [*_linear_part(fit), *_load_scale(fit)]
    unstable = _softened(fit)
    if unstable.size:
        warnings.append(Fact("other_regime", **of(used[unstable])))
    if not np.all(np.isfinite(fit.left_out.cross_validated)):
        warnings.append(Fact("not_checked"))
    if fit.cases.energy is not None and not inconsistent.size:
        error = energy_error(fit.basis, fit.cases, fit.potential)
        off = np.flatnonzero(~(np.abs(error) < _ENERGY))
        if off.size:
            largest = float(np.max(np.abs(error[off])))
            warnings.append(Fact("energy", largest=largest, **of(used[off])))
    return tuple(warnings)


def linear_stiffness_ratio(fit: FitView) -> Float[np.ndarray, " mode"]:
    """Linear stiffness from the load cases, over ω²; NaN if they are too few.

    It is one if shapes are mass-normalised and units and loads are consistent.
    """
    n_cases, n = fit.cases.force.shape
    monomials = monomials_of(n, fit.degree, 1)
    if n_cases * n < len(monomials) + n:
        return np.full(n, np.nan)
    system = fit_system(fit.basis, fit.cases, monomials)
    values = np.asarray(solve_scaled(system) * system.column_scale)
    quadratic = np.array([values[monomials.index((m, m))] for m in range(n)])
    return 1.0 + 2.0 * quadratic / np.asarray(fit.basis.frequency) ** 2


def energy_error(
    basis: ReductionBasis, cases: StaticCases, potential: PolynomialPotential
) -> Float[np.ndarray, " case"]:
    """Relative error of the reduced model's energy, for each case."""
    q = np.asarray(cases.modal_displacement)
    energy = np.asarray(cases.energy, dtype=float)
    linear = 0.5 * (q**2 @ np.asarray(basis.frequency) ** 2)
    return (linear + np.asarray(potential.energy(q)) - energy) / energy


def _repeated(force: Float[np.ndarray, "case mode"]) -> tuple[int, int] | None:
    """Rows of the first two cases with the same load."""
    largest = np.max(np.abs(force), initial=0.0)
    for k in range(1, len(force)):
        same = np.flatnonzero(np.all(np.abs(force[:k] - force[k]) <= 1e-9 * largest, axis=1))
        if same.size:
            return int(same[0]), k
    return None


def _inconsistent(fit: FitView) -> np.ndarray:
    """The few cases without which the others fit ten times as well; empty if there are none.

    First those whose compliance is far from that of the others. Otherwise the worst case is
    removed and the rest refitted, repeatedly for up to a fifth of the cases.
    """
    compliance = _displacement_ratio(fit.basis, fit.cases.force, fit.cases.modal_displacement)
    other = np.abs(np.log(compliance / np.median(compliance))) > np.log(_UNIT)
    if other.any():
        return np.flatnonzero(other)
    design, target = np.asarray(fit.system.design), np.asarray(fit.system.target)
    n_cases, n_modes, n_unknowns = design.shape
    start = float(np.sum(fit.left_out.residual**2))
    keep, nothing = np.arange(n_cases), np.zeros(0, dtype=int)
    if not fit.misfit > _GOOD or not rms(fit.left_out.residual) > _ROUND_OFF:
        return nothing
    for _ in range(max(1, n_cases // 5)):
        if (len(keep) - 1) * n_modes <= n_unknowns:
            return nothing
        q, _ = np.linalg.qr(design[keep].reshape(-1, n_unknowns))
        y = target[keep]
        residual = y - (q @ (q.T @ y.reshape(-1))).reshape(y.shape)
        blocks = q.reshape(len(keep), n_modes, n_unknowns)
        rest = (1 + 1e-9) * np.eye(n_modes) - blocks @ blocks.transpose(0, 2, 1)
        cross_validated = np.linalg.solve(rest, residual[..., None])[..., 0]
        gain = np.sum(residual * cross_validated, axis=1)
        worst = int(np.argmax(gain))
        keep = np.delete(keep, worst)
        if np.sum(residual**2) - gain[worst] < _ONE_CASE * start:
            return np.setdiff1d(np.arange(n_cases), keep)
    return nothing


def _compared_with_linear(fit: FitView, rows: np.ndarray) -> tuple[bool, float | None]:
    """Probable cause of inconsistent cases.

    Whether all move against their force, and the ratio to the linear displacement if that is far
    from one.
    """
    force = np.asarray(fit.cases.force)[rows]
    linear = np.asarray(fit.cases.modal_displacement)[rows] * np.asarray(fit.basis.frequency) ** 2
    if np.all(np.sum(force * linear, axis=1) < 0):
        return True, None
    ratio = _displacement_ratio(fit.basis, force, fit.cases.modal_displacement[rows])
    far = np.all(ratio > _UNIT) or np.all(ratio < 1 / _UNIT)
    return False, float(np.median(ratio)) if far else None


def _displacement_ratio(basis: ReductionBasis, force: Array, moved: Array) -> np.ndarray:
    """Norm of each displacement over that of the linear structure under the same load."""
    squared = np.asarray(basis.frequency) ** 2
    return np.linalg.norm(np.asarray(moved), axis=1) / np.linalg.norm(force / squared, axis=1)


def _linear_part(fit: FitView) -> list[Fact]:
    ratio = linear_stiffness_ratio(fit)
    off = np.flatnonzero(np.abs(ratio - 1) > _LINEAR).tolist()
    modes = tuple(fit.basis.numbers[m] for m in off)
    ratios = tuple(float(ratio[m]) for m in off)
    return [Fact("linear_part", modes=modes, ratios=ratios)] if off else []


def _load_scale(fit: FitView) -> list[Fact]:
    """Whether the loads are too small, or too large for the degree."""
    if fit.misfit < _GOOD:
        return []
    n_cases, n_modes = fit.system.target.shape
    fraction = rms(fit.system.target)
    small = [Fact("too_small", misfit=fit.misfit, nonlinear=fraction)]
    if rms(fit.left_out.residual) < _ROUND_OFF:
        return small
    higher = fit_system(fit.basis, fit.cases, monomials_of(n_modes, fit.degree + 2))
    design = np.asarray(higher.design).reshape(n_cases * n_modes, -1)
    spare = design.shape[0] - design.shape[1]
    if spare > n_modes:
        values = np.linalg.lstsq(design, np.asarray(higher.target).reshape(-1), rcond=1e-12)[0]
        residual = rms(design @ values - np.asarray(higher.target).reshape(-1))
        residual *= np.sqrt(design.shape[0] / spare)
        longer = bool(residual < _EXPLAINED * rms(fit.left_out.residual))
    else:
        longer = fraction > _SMALL
    if fraction < _SMALL and not longer:
        return small
    return [Fact("too_large", misfit=fit.misfit, degree=fit.degree, longer=longer)]


def _softened(fit: FitView) -> np.ndarray:
    """Cases where the tangent stiffness of the reduced model has a negative eigenvalue."""
    tangent = np.asarray(fit.potential.stiffness(fit.cases.modal_displacement))
    scale = np.asarray(fit.basis.frequency)
    scaled = tangent / (scale[:, None] * scale) + np.eye(len(scale))
    return np.flatnonzero(np.linalg.eigvalsh(scaled)[:, 0] <= 0)
