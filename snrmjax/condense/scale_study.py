"""Sensitivity of a reduced-order model's coefficients to the scale of its load cases."""

from collections.abc import Callable, Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.condense.case_checks import rms
from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.load_set import StaticSolver, modal_loads
from snrmjax.condense.potential_fit import fit_system, monomials_of, solve_scaled
from snrmjax.model.potential import Monomial, monomial_key
from snrmjax.numerics.result import AbstractResult, Variable, quantity
from snrmjax.numerics.rules import InputError

SCALES = tuple(float(scale) for scale in np.logspace(-2.0, 0.75, 12))
"""Default multiples of the displacement: two decades below and three quarters of one above."""

TOLERANCE = 0.02
"""Permitted relative spread of the leading coefficients within a plateau."""

_LEADING = 0.1  # of the largest term's force, for a coefficient to count in the plateau


class LoadScaleStudy(AbstractResult):
    """Coefficients over load scale, and the range in which they do not depend on it.

    Too small loads are dominated by round-off, too large ones by truncated terms.
    `plateau` is the longest range of scales over which every leading coefficient stays within
    `TOLERANCE`; leading are those whose term has at least a tenth of the force of the largest term
    of its degree at scale 1. None: there is no plateau of two scales.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("load_scale", "monomial")

    leading: tuple[bool, ...] = eqx.field(static=True)
    monomials: tuple[Monomial, ...] = eqx.field(static=True)
    scale: Float[np.ndarray, " scale"] = quantity(
        "load_scale", "1", "multiple of the nominal displacement", name="load_scale"
    )
    # NaN where load cases failed.
    coefficient: Float[np.ndarray, "scale monomial"] = quantity(
        "load_scale monomial", "kg, m, s", "coefficient of V"
    )
    misfit: Float[np.ndarray, " scale"] = quantity(
        "load_scale", "1", "residual over nonlinear force"
    )
    nonlinear_ratio: Float[np.ndarray, " scale"] = quantity(
        "load_scale", "1", "nonlinear over linear force, the largest"
    )
    plateau: tuple[float, float] | None = eqx.field(static=True, default=None)

    @property
    def decades(self) -> float:
        """Width of the plateau in powers of ten; 0 if there is none."""
        return 0.0 if self.plateau is None else float(np.log10(self.plateau[1] / self.plateau[0]))

    @property
    def holds_default(self) -> bool:
        """Whether scale 1 lies inside the plateau."""
        return self.plateau is not None and self.plateau[0] < 1.0 < self.plateau[1]

    def summary(self) -> tuple[str, ...]:
        """Range of scales and plateau."""
        solved = int(np.isfinite(self.misfit).sum())
        first = f"LoadScaleStudy: {len(self.scale)} load scales, {solved} with all cases solved"
        if self.plateau is None:
            return first, "no plateau"
        low, high = self.plateau
        where = "inside it" if self.holds_default else "not inside it"
        return (
            first,
            f"plateau from {low:.3g} to {high:.3g} ({self.decades:.2g} decades); scale 1 {where}",
        )

    def variables(self) -> Mapping[str, Variable]:
        """Coefficients and quality over scale, by monomial."""
        keys = np.array([monomial_key(m) for m in self.monomials])
        named = Variable(("monomial",), keys, "", "modes of the monomial of V")
        return {**super().variables(), "monomial": named}


def load_scale_study(
    basis: ReductionBasis,
    solve: StaticSolver,
    displacement: float | Float[Array | np.ndarray, " mode"],
    *,
    degree: int = 3,
    scales: tuple[float, ...] = SCALES,
    report: Callable[[int, int], None] | None = None,
) -> LoadScaleStudy:
    """Condense with loads of several scales.

    Arguments: `displacement` in m, as for `modal_loads`; `scales` ascending multiples of it, 1
    among or between them; `report` is called with the numbers of finished and of all scales.
    Returns coefficients over scale and the plateau. A scale whose load cases do not all converge
    has NaN and ends a plateau. Raises `ValueError` for scales that do not ascend.
    """
    scale = np.asarray(scales, dtype=float)
    if scale.ndim != 1 or scale.size < 2 or not np.all(np.diff(scale) > 0) or not scale[0] > 0:
        raise InputError(f"`scales` must be positive and ascending, at least two, but is {scales}.")
    monomials = monomials_of(len(basis.numbers), degree)
    coefficient = np.full((scale.size, len(monomials)), np.nan)
    misfit, ratio = np.full(scale.size, np.nan), np.full(scale.size, np.nan)
    typical = np.ones(len(basis.numbers))
    nearest = int(np.argmin(np.abs(np.log(scale))))
    for k, factor in enumerate(scale):
        loads = modal_loads(basis, factor * np.asarray(displacement), degree=degree)
        cases = solve(np.asarray(loads.force))
        if k == nearest:
            typical = typical_displacement(cases) / factor
        if cases.usable.all():
            coefficient[k], misfit[k], ratio[k] = _fitted(basis, cases, monomials)
        if report is not None:
            report(k + 1, scale.size)
    leading = leading_terms(coefficient[nearest], typical, monomials)
    return LoadScaleStudy(
        scale=scale,
        coefficient=coefficient,
        misfit=misfit,
        nonlinear_ratio=ratio,
        leading=tuple(bool(leads) for leads in leading),
        plateau=plateau_of(scale, coefficient[:, leading]),
        monomials=monomials,
    )


def plateau_of(
    scale: Float[np.ndarray, " scale"], coefficient: Float[np.ndarray, "scale monomial"]
) -> tuple[float, float] | None:
    """The longest range of scales (in ratio) over which all coefficients stay within `TOLERANCE`.

    >>> plateau_of(np.array([1.0, 2.0, 4.0, 8.0]), np.array([[3.0], [1.0], [1.01], [1.5]]))
    (2.0, 4.0)
    """
    best = None
    for first in range(len(scale)):
        for last in range(first + 1, len(scale)):
            rows = coefficient[first : last + 1]
            spread = rows.max(axis=0) - rows.min(axis=0)
            middle = np.abs(np.median(rows, axis=0))
            if not rows.size or not np.all(spread <= TOLERANCE * middle):
                break
            ends = (float(scale[first]), float(scale[last]))
            if best is None or ends[1] / ends[0] > best[1] / best[0]:
                best = ends
    return best


def _fitted(
    basis: ReductionBasis, cases: StaticCases, monomials: tuple[Monomial, ...]
) -> tuple[np.ndarray, float, float]:
    """Coefficients, residual over nonlinear force, and the largest nonlinear over linear force."""
    system = fit_system(basis, cases, monomials)
    scaled = np.asarray(solve_scaled(system))
    design, target = np.asarray(system.design), np.asarray(system.target)
    linear = np.asarray(cases.force) / np.asarray(system.row_scale) - target
    ratio = np.linalg.norm(target, axis=1) / np.linalg.norm(linear, axis=1)
    misfit = rms(target - design @ scaled) / rms(target)
    return scaled * np.asarray(system.column_scale), misfit, float(ratio.max())


def typical_displacement(cases: StaticCases) -> Float[np.ndarray, " mode"]:
    """Modal displacements, rms over the converged load cases."""
    moved = np.asarray(cases.modal_displacement)[cases.usable]
    return np.sqrt(np.mean(moved**2, axis=0)) if len(moved) else np.ones(moved.shape[1])


def leading_terms(
    coefficient: Float[np.ndarray, " monomial"],
    typical: Float[np.ndarray, " mode"],
    monomials: tuple[Monomial, ...],
) -> Bool[np.ndarray, " monomial"]:
    """Coefficients whose terms have a tenth of the energy of the largest of their degree."""
    energy = np.array([np.prod(typical[list(m)]) for m in monomials]) * np.abs(coefficient)
    degree = np.array([len(m) for m in monomials])
    known = np.nan_to_num(energy)
    largest = np.array([known[degree == d].max() for d in degree])
    # Odd terms of a flat structure are rounding: degrees with hardly any energy do not count.
    return (known >= _LEADING * largest) & (largest >= _LEADING**2 * known.max())
