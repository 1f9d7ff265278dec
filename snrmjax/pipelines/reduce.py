"""A reduced-order model from its source: load cases, condensation, range of validity."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from snrmjax.condense.condensation import Condensation, reduced_model
from snrmjax.condense.load_cases import StaticCases
from snrmjax.condense.load_set import modal_loads
from snrmjax.condense.reduction import ReductionSource, run_load_cases
from snrmjax.condense.scale_study import (
    TOLERANCE,
    LoadScaleStudy,
    leading_terms,
    load_scale_study,
    typical_displacement,
)
from snrmjax.io.calculix.reduction import read_deck_source
from snrmjax.io.files import FilePath
from snrmjax.io.reduction.beam_file import read_beam
from snrmjax.io.reduction.load_tables import read_load_tables
from snrmjax.model.potential import monomial_key
from snrmjax.model.structures import Structure, equilibria
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.options import ReduceOptions, checked

_SWEEP = (2.0, 3.0, 5.0, 7.5, 10.0)  # times the loads of single modes, for the model's range
_FEW_SCALES = (0.1, 0.3, 1.0, 3.0)  # of a study with expensive load cases
_MEANINGLESS = 0.5  # relative error of a force or a coefficient above which the model is refused
_REFUSED_LINEAR = (
    0.2  # relative deviation of the linear stiffness above which load cases are refused
)


class Reduction(NamedTuple):
    """A reduced-order model with its source, load cases and study."""

    source: ReductionSource
    condensation: Condensation
    structure: Structure
    displacement: np.ndarray | None  # m, linear displacement of single modes; None for tables
    study: LoadScaleStudy | None
    sweep: StaticCases | None  # single modes at larger loads; None for tables
    notes: tuple[Fact | str, ...]

    @property
    def load_scale(self) -> float | None:
        """The largest of those displacements, in thicknesses."""
        if self.displacement is None or self.source.thickness is None:
            return None
        return float(np.max(self.displacement)) / self.source.thickness

    @property
    def mode_names(self) -> list[str]:
        """Modes as named in texts."""
        basis = self.condensation.basis
        hertz = np.asarray(basis.frequency) / HERTZ
        return [f"mode {n} ({h:.4g} Hz)" for n, h in zip(basis.numbers, hertz, strict=True)]


def reduce_model(
    source: ReductionSource,
    *,
    study: bool = True,
    report: Callable[[int, int], None] | None = None,
) -> Reduction:
    """Run missing load cases, condense them, and study the influence of the load scale.

    Raises `ValueError` where load cases contradict one another or the modes, where they do not
    determine the model, and where none of them has a solution.
    """
    displacement, cases = None, source.cases
    if cases is None:
        displacement, cases = run_load_cases(source)
    condensation = reduced_model(source.basis, cases, degree=source.degree)
    _refuse_contradictions(source, condensation)
    compared = _stated_scale_compared(source, condensation)
    scales = sweep = None
    if displacement is not None and source.solve is not None:
        far = modal_loads(source.basis, displacement, most_modes=1, levels=_SWEEP)
        sweep = source.solve(np.asarray(far.force))
    if study and source.solve is not None and displacement is not None:
        scales = load_scale_study(
            source.basis,
            source.solve,
            displacement,
            degree=source.degree,
            scales=source.scales,
            report=report,
        )
    structure = source.structure(condensation)
    notes: list[Fact | str] = [*source.notes, *compared]
    notes += condensation.warnings
    if scales is not None and not scales.holds_default:
        notes.append(Fact("load_scale_outside_plateau"))
    states = [one for one in equilibria(structure) if one.stable]
    if len(states) > 1:
        notes.append(Fact("several_equilibria", n=len(states)))
    return Reduction(source, condensation, structure, displacement, scales, sweep, tuple(notes))


def _refuse_contradictions(source: ReductionSource, condensation: Condensation) -> None:
    if source.cases is None:
        return
    for warning in condensation.warnings:
        if warning.kind == "inconsistent_case":
            raise InputError(f"{warning}; correct or remove it.")
    ratio = condensation.quality.linear_stiffness_ratio
    worst = int(np.argmax(np.abs(np.nan_to_num(ratio, nan=1.0) - 1)))
    if abs(ratio[worst] - 1) > _REFUSED_LINEAR:
        raise InputError(
            f"the load cases show {ratio[worst]:.4g} times the squared natural frequency of mode "
            f"{condensation.basis.numbers[worst]} as linear stiffness: units, loads, shapes and "
            "frequencies are inconsistent."
        )


def _stated_scale_compared(source: ReductionSource, condensation: Condensation) -> list[Fact]:
    """Note on how a stated load scale changes the coefficients from those of the default scale.

    Raises `ValueError` where the model is not valid: where the potential's misfit exceeds half of
    the nonlinear force of its own load cases, or where a leading coefficient differs from that of
    the default scale by more than half.
    """
    if source.load_scale is None or source.solve is None or source.thickness is None:
        return []
    stated, misfit = (
        f"`load_scale` = {source.load_scale:g} thicknesses",
        condensation.quality.misfit,
    )
    if misfit > _MEANINGLESS:
        raise InputError(
            f"with {stated} the misfit of the potential is {100 * misfit:.0f} % of the nonlinear "
            "force of its own load cases, so that the model is not valid: leave the key out for "
            "the default scale."
        )
    try:
        displacement, cases = run_load_cases(source._replace(load_scale=None))
    except InputError as error:
        why = str(error)
        return [Fact("load_scale_not_compared", stated=source.load_scale, why=why)]
    chosen = reduced_model(source.basis, cases, degree=source.degree)
    scale = float(np.max(displacement)) / source.thickness
    monomials, own = chosen.potential.monomials, np.asarray(chosen.potential.coefficient)
    leading = np.flatnonzero(leading_terms(own, typical_displacement(cases), monomials))
    change = np.asarray(condensation.potential.coefficient)[leading] / own[leading] - 1
    worst = int(np.argmax(np.abs(change)))
    if not abs(change[worst]) > TOLERANCE:
        return []
    fact = Fact(
        "load_scale_compared",
        stated=source.load_scale,
        coefficient=monomial_key(monomials[leading[worst]]),
        change=float(change[worst]),
        chosen=scale,
    )
    if abs(change[worst]) > _MEANINGLESS:
        raise InputError(f"{fact}: leave the key out, or state a smaller scale.")
    return [fact]


def read_reduction_source(
    beam: FilePath | None = None, options: ReduceOptions | None = None, **settings: Any
) -> ReductionSource:
    """Source of the reduction: exactly one of a beam file, load tables and a CalculiX deck.

    Raises `ValueError` for none or several of them, and as the readers do.
    """
    options = checked(dataclasses.replace(options or ReduceOptions(), **settings))
    sources = {"BEAM": beam, "--tables": options.tables, "--calculix": options.calculix}
    given = [name for name, path in sources.items() if path is not None]
    if len(given) != 1:
        listed = " and ".join(given) or "none of them"
        raise InputError(f"`rom` needs one of BEAM, --tables and --calculix, but has {listed}.")
    if options.tables is not None:
        return read_load_tables(options.tables)
    if beam is not None:
        return read_beam(beam)
    source = read_deck_source(options.calculix or "", _mode_numbers(options.modes))
    return source._replace(scales=_FEW_SCALES)


def _mode_numbers(modes: str | None) -> tuple[int, ...]:
    parts = [part.strip() for part in (modes or "").split(",")]
    numbers = [int(part) for part in parts if part.isdecimal() and int(part) > 0]
    if len(numbers) < len(parts) or len(set(numbers)) < len(numbers):
        given = "not given" if modes is None else repr(modes)
        raise InputError(f"`--modes` must be different mode numbers such as 1,3,5, but is {given}.")
    return tuple(numbers)
