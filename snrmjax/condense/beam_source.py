"""A beam as the source of a reduced-order model: finite elements and modes."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.beam_parameters import (
    LENGTH,
    SIDES,
    STIFFNESSES,
    THICKNESS,
    BeamDescription,
    rise_of,
)
from snrmjax.condense.elements.beam import Beam, PointMass, Support
from snrmjax.condense.elements.beam_modes import beam_modes, participation, shape_at
from snrmjax.condense.elements.statics import static_cases
from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.load_set import StaticSolver
from snrmjax.condense.reduction import ASSUMED_DAMPING, ReductionSource, ShapeLines
from snrmjax.model.modes import have_values
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_BLOCK = 8  # load cases at once
_NODE = 1e-9  # of the largest shape, below which a point is a node of all modes


def beam_source(stated: BeamDescription, file: str) -> ReductionSource:
    """Prepare finite elements, modes and load cases of a beam; messages name its `file`.

    Beams that differ only in their dimensions share compiled programs. Traced numbers (within
    `jax.jit` and derivatives) are not checked. Raises `ValueError` for modes that the mesh does
    not have, and for a sensor or force at a node of all modes.
    """
    beam = beam_of(stated)
    try:
        basis = beam_modes(beam, stated.modes)
    except InputError as error:
        raise InputError.located(file, error) from error
    modal = _modal_data(beam, basis, stated.sensors, stated.force_at)
    known = have_values((basis, modal))
    if known:
        modal = jax.tree.map(np.asarray, modal)
        _require_moving(stated, modal, file)

    def solve(force: Float[np.ndarray, "case mode"]) -> StaticCases:
        if not known:
            return static_cases(beam, basis, force)
        return _in_blocks(lambda rows: static_cases(beam, basis, rows), force)

    damping = stated.damping_ratio
    return ReductionSource(
        name=stated.name,
        basis=basis,
        damping_ratio=np.array(damping or (ASSUMED_DAMPING,) * len(stated.modes)),
        sensors=modal.sensors,
        participation=modal.participation,
        solve=solve,
        thickness=dict(stated.numbers)[THICKNESS],
        load_scale=stated.load_scale,
        degree=stated.degree,
        # Rows of the shapes are x, y and rotation of each node.
        lines=ShapeLines(modal.position, basis.shapes[1::3], "Position along the chord (m)"),
        notes=() if damping else (Fact("damping_assumed", ratio=ASSUMED_DAMPING),),
    )


def _require_moving(stated: BeamDescription, modal: "_ModalData", file: str) -> None:
    largest = float(np.max(modal.largest))
    for name, at in stated.sensors:
        if not np.max(np.abs(modal.sensors[name])) > _NODE * largest:
            raise InputError(f"[sensors] of {file} has `{name}` at {at:g}, where no mode moves.")
    if not np.max(np.abs(modal.participation)) > _NODE * largest:
        position = "uniform" if stated.force_at is None else f"at {stated.force_at:g}"
        raise InputError(f"[force] of {file} is {position}, where no mode moves.")


class _ModalData(NamedTuple):
    """Mode shapes at the sensors and participation of the force."""

    sensors: dict[str, Float[Array, " mode"]]  # kg^-1/2
    participation: Float[Array, " mode"]  # per newton, kg^-1/2
    largest: Float[Array, " mode"]  # kg^-1/2
    position: Float[Array, " node"]  # along the chord, m


@compiled
def _modal_data(
    beam: Beam,
    basis: ReductionBasis,
    sensors: tuple[tuple[str, float], ...],
    force_at: float | None,
) -> _ModalData:
    """Shapes at the sensors and participation of the force; positions are fractions of length."""
    return _ModalData(
        {name: shape_at(beam, basis, at) for name, at in sensors},
        participation(beam, basis, force_at),
        basis.largest,
        beam.nodes[:, 0],
    )


def beam_of(stated: BeamDescription) -> Beam:
    """The finite elements of a beam."""
    of = dict(stated.numbers)
    left, right = (Support(*(of[f"supports.{s}.{key}"] for key in STIFFNESSES)) for s in SIDES)
    masses = enumerate(stated.masses_at, 1)
    return Beam(
        of[LENGTH],
        of["section.width_m"],
        of[THICKNESS],
        rise=rise_of(stated),
        young=of["material.young_pa"],
        density=of["material.density_kg_m3"],
        poisson=of.get("material.poisson"),
        elements=stated.elements,
        left=left,
        right=right,
        point_masses=tuple(
            PointMass(at, of[f"point_mass_{k}.mass_kg"], of[f"point_mass_{k}.inertia_kg_m2"])
            for k, at in masses
        ),
    )


def _in_blocks(solve: StaticSolver, force: Float[np.ndarray, "case mode"]) -> StaticCases:
    """Load cases in blocks of fixed length, so that one program serves any number of them."""
    count = len(force)
    rows = np.resize(np.arange(count), -(-count // _BLOCK) * _BLOCK)
    blocks = [solve(np.asarray(force)[part]) for part in rows.reshape(-1, _BLOCK)]
    joined: StaticCases = jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)
    return joined
