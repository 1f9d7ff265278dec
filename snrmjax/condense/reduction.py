"""The source of a reduced-order model: modes, load cases or their solver, and metadata."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.condensation import Condensation
from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.load_set import StaticSolver, displacement_for_ratio, modal_loads
from snrmjax.condense.scale_study import SCALES
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

ASSUMED_DAMPING = 0.01
"""Default damping ratio of a mode, which a finite-element model does not have."""


class ShapeLines(NamedTuple):
    """Mode shapes along a structure, for plots."""

    position: Float[np.ndarray | Array, " point"]  # m along the structure
    shape: Float[np.ndarray | Array, "point mode"]  # transverse, kg^-1/2
    axis: str = "Position along the structure (m)"


class ReductionSource(NamedTuple):
    """Modes to keep, load cases or their solver, and further data of a model.

    `cases` are available load cases; if None, `solve` runs them.
    """

    name: str
    basis: ReductionBasis
    damping_ratio: Float[np.ndarray, " mode"]
    sensors: Mapping[str, Float[np.ndarray | Array, " mode"]]  # mode shapes there, kg^-1/2
    participation: Float[np.ndarray | Array, " mode"]  # Φᵀb per newton, kg^-1/2
    cases: StaticCases | None = None
    solve: StaticSolver | None = None
    thickness: float | None = None  # m, the unit of `load_scale`
    load_scale: float | None = None  # linear displacement of single modes, thicknesses
    degree: int = 3
    scales: tuple[float, ...] = SCALES  # of the study over load scale
    lines: ShapeLines | None = None
    notes: tuple[Fact, ...] = ()

    def structure(self, condensation: Condensation) -> Structure:
        """The reduced model as a structure, for a model file."""
        return condensation.structure(
            self.damping_ratio,
            sensors=self.sensors,
            participation=self.participation,
            name=self.name,
        )


def run_load_cases(
    source: ReductionSource, displacement: Float[np.ndarray | Array, " mode"] | None = None
) -> tuple[Any, StaticCases]:
    """Run the load cases for a displacement, the given load scale, or the default one.

    Arguments: `displacement` in m of the linear structure under the loads of single modes.
    Returns it, and the cases. Raises `ValueError` without a solver and as
    `displacement_for_ratio` does.
    """
    if source.solve is None:
        raise InputError(f"{source.name} has neither load cases nor a solver for them.")
    n = len(source.basis.numbers)
    if displacement is None and source.load_scale is not None:
        displacement = np.full(n, source.load_scale * (source.thickness or 1.0))
    elif displacement is None:
        start = 0.1 * (source.thickness or 1e-3)
        displacement = displacement_for_ratio(source.basis, source.solve, start=start)
    loads = modal_loads(source.basis, displacement, degree=source.degree)
    traced = isinstance(loads.force, jax.core.Tracer)
    force: Any = loads.force if traced else np.asarray(loads.force)
    cases = source.solve(force)
    return displacement, dataclasses.replace(cases, names=loads.names)
