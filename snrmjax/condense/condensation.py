"""Implicit condensation: a reduced-order model from static load cases, with checks."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.case_checks import (
    FitView,
    case_warnings,
    energy_error,
    linear_stiffness_ratio,
    rms,
)
from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.potential_fit import (
    check_degree,
    fit_potential,
    fit_system,
    leave_out,
    monomials_of,
    require_determined,
)
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import PolynomialPotential, monomial_key
from snrmjax.model.structures import Structure, structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, setting
from snrmjax.numerics.rules import InputError


class FitQuality(eqx.Module):
    """Quality of the fit of one potential to the load cases; errors are rms over them.

    `misfit` and `cross_validated` are of all equations together, over the nonlinear force; those
    of `equation_…` are of each modal equation, over the force on that mode. Cross-validated:
    every case predicted by the fit to all others. NaN within `jit` and derivatives, where nothing
    is checked.
    """

    misfit: float
    cross_validated: float
    equation_residual: Float[np.ndarray, " mode"]
    equation_cross_validated: Float[np.ndarray, " mode"]
    case_error: Float[np.ndarray, " case"]  # cross-validated, over the nonlinear force; NaN: unused
    nonlinear_ratio: Float[np.ndarray, " case"]  # nonlinear over linear force
    linear_stiffness_ratio: Float[np.ndarray, " mode"]  # from the cases, over ω²
    condition: float  # number, of the least-squares problem with scaled columns
    energy_error: Float[np.ndarray, " case"] | None  # relative


class Condensation(AbstractResult):
    """A reduced-order model from static load cases, ω²q + ∂V/∂q = f, and its quality.

    `potential.coefficient_std` is the jackknife over load cases: the sensitivity of a coefficient
    to the choice of cases. Read `warnings` before the model is used.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("monomial",)

    basis: ReductionBasis
    cases: StaticCases
    potential: PolynomialPotential
    quality: FitQuality
    warnings: tuple[Fact, ...] = setting()
    degree: int = setting()

    def variables(self) -> Mapping[str, Variable]:
        """The coefficients by monomial."""
        keys = np.array([monomial_key(m) for m in self.potential.monomials])
        at, unit, potential = ("monomial",), "kg, m, s", self.potential
        return {
            "monomial": Variable(at, keys, "", "modes of the monomial of V"),
            "coefficient": Variable(
                at, potential.coefficient, unit, "coefficient of the potential"
            ),
            "coefficient_std": Variable(at, potential.coefficient_std, unit, "1σ over load cases"),
            "misfit": Variable((), self.quality.misfit, "1", "residual over nonlinear force"),
            "cross_validated": Variable(
                (), self.quality.cross_validated, "1", "the same of cases that were left out"
            ),
        }

    def force(self, displacement: Float[Array, "*batch mode"]) -> Float[Array, "*batch mode"]:
        """Static modal force at modal displacements, linear part included, kg^1/2 m/s²."""
        q = jnp.asarray(displacement)
        return q * jnp.asarray(self.basis.frequency) ** 2 + self.potential.force(q)

    def structure(
        self,
        damping_ratio: float | Float[np.ndarray | Array, " mode"] | list[float],
        *,
        sensors: Mapping[str, Any],
        participation: Float[np.ndarray | Array, " mode"] | list[float],
        mode_of_interest: int = 0,
        name: str = "reduced model",
    ) -> Structure:
        """The reduced model as a `Structure`.

        Arguments: `damping_ratio` of each mode, or one for all; `sensors` maps a name to the mode
        shapes there (kg^-1/2, one per mode: rows of `basis.shapes`, or averages of them);
        `participation` Φᵀb per newton of the recorded force; `mode_of_interest` from zero.
        Raises `ValueError` as `linear_modes` does.
        """
        n = len(self.basis.numbers)
        ratio = damping_ratio if np.ndim(damping_ratio) else [damping_ratio] * n
        modes = linear_modes(
            self.basis.frequency,
            ratio,  # type: ignore[arg-type]
            [row if np.ndim(row) else [row] for row in sensors.values()],
            participation,
            sensors=tuple(sensors),
            mode_of_interest=mode_of_interest,
        )
        return structure(modes, self.potential, name=name)


def reduced_model(basis: ReductionBasis, cases: StaticCases, *, degree: int = 3) -> Condensation:
    """Fit one potential V to static load cases, f = ω²q + ∂V/∂q, and check both.

    Arguments: `degree` of the nonlinear force (3: quadratic and cubic), up to 7.
    Returns the model with residuals, condition number, cross-validated error and warnings. Within
    `jax.jit` and derivatives it is the same fit without checks, with coefficients of NaN if a load
    case did not converge. Raises `ValueError` if the cases are too few or do not determine every
    coefficient, naming some.
    Validity: amplitudes up to those of the load cases; motions outside the kept modes must follow
    them statically (natural frequencies well above the response's harmonics).
    Reference: Hollkamp & Gordon, J. Sound Vib. 318 (2008) 1139, doi:10.1016/j.jsv.2008.04.035.

    >>> basis = ReductionBasis(np.array([2.0]), np.eye(1), np.eye(1), (1,))
    >>> q = np.array([[-1.0], [-0.5], [0.5], [1.0]])
    >>> cases = StaticCases(4 * q + 3 * q**2 + q**3, q, np.ones(4, dtype=bool))
    >>> reduced_model(basis, cases).potential.coefficient.round(9)
    Array([1.  , 0.25], dtype=float64)
    """
    check_degree(degree)
    n_modes = len(basis.numbers)
    if cases.force.shape[1] != n_modes:
        raise InputError(
            f"the load cases have {cases.force.shape[1]} modes, but the basis has {n_modes}."
        )
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((basis, cases))):
        return _unchecked(basis, cases, degree)
    used = np.flatnonzero(cases.usable)
    if not used.size:
        raise InputError(
            f"none of the {len(cases.force)} load cases has a solution: smaller loads are needed."
        )
    arrays = dataclasses.replace(cases, names=())
    solved: StaticCases = jax.tree.map(lambda values: np.asarray(values)[used], arrays)
    monomials = monomials_of(n_modes, degree)
    for what, rows in (("force", solved.force), ("modal displacement", solved.modal_displacement)):
        zero_modes = np.flatnonzero(~np.any(np.asarray(rows) != 0, axis=0))
        if zero_modes.size:
            raise InputError(
                f"the {what} of mode {basis.numbers[zero_modes[0]]} is zero in every load case."
            )
    system = fit_system(basis, solved, monomials)
    require_determined(system, monomials, used.size)
    left_out = leave_out(system)
    spread = jnp.asarray(left_out.std * np.asarray(system.column_scale))
    # An unknown standard deviation is stored as zero.
    spread = jnp.where(jnp.isfinite(spread), spread, 0.0)
    potential = dataclasses.replace(
        fit_potential(basis, solved, degree=degree), coefficient_std=spread
    )
    view = FitView(basis, solved, potential, system, left_out, degree)
    return Condensation(
        basis=basis,
        cases=cases,
        potential=potential,
        quality=_quality(view, used, len(cases.force)),
        warnings=case_warnings(cases, view),
        degree=degree,
    )


def _unchecked(basis: ReductionBasis, cases: StaticCases, degree: int) -> Condensation:
    """The fit alone, for traced numbers."""
    fitted = fit_potential(basis, cases, degree=degree)
    coefficient = jnp.where(jnp.all(cases.converged), fitted.coefficient, jnp.nan)
    potential = dataclasses.replace(fitted, coefficient=coefficient)
    by_mode, by_case = (np.full(size, np.nan) for size in cases.force.shape[::-1])
    no_quality = FitQuality(
        np.nan, np.nan, by_mode, by_mode, by_case, by_case, by_mode, np.nan, energy_error=None
    )
    return Condensation(basis, cases, potential, no_quality, (), degree)


def _quality(fit: FitView, used: np.ndarray, n_cases: int) -> FitQuality:
    target, left_out = np.asarray(fit.system.target), fit.left_out
    force = np.asarray(fit.cases.force) / np.asarray(fit.system.row_scale)
    linear = np.linalg.norm(force - target, axis=1)
    force_rms = np.sqrt(np.mean(force**2, axis=0))

    def by_case(values: np.ndarray) -> np.ndarray:
        rows = np.full(n_cases, np.nan)
        rows[used] = values
        return rows

    known = np.all(np.isfinite(left_out.cross_validated))
    cross_validated = left_out.cross_validated if known else np.full(target.shape, np.nan)
    nonlinear = np.linalg.norm(target, axis=1)
    energy = None
    if fit.cases.energy is not None:
        energy = by_case(energy_error(fit.basis, fit.cases, fit.potential))
    return FitQuality(
        misfit=fit.misfit,
        cross_validated=rms(cross_validated) / rms(target),
        equation_residual=np.sqrt(np.mean(left_out.residual**2, axis=0)) / force_rms,
        equation_cross_validated=np.sqrt(np.mean(cross_validated**2, axis=0)) / force_rms,
        case_error=by_case(np.linalg.norm(left_out.cross_validated, axis=1) / nonlinear),
        nonlinear_ratio=by_case(nonlinear / linear),
        linear_stiffness_ratio=linear_stiffness_ratio(fit),
        condition=left_out.condition,
        energy_error=energy,
    )
