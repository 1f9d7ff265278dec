"""A beam file as what a reduced-order model is made from: its finite elements and their modes."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.condense.corotational_beam import (
    CorotationalBeam,
    RectangularSection,
    beam_static_cases,
    corotational_beam,
    line_load,
    transverse_row,
)
from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.load_set import StaticSolver
from snrmjax.io.files import FilePath, file_name
from snrmjax.io.reduction.beam_file import BeamDescription, read_beam_description
from snrmjax.io.reduction.source import ASSUMED_DAMPING, ReductionSource, ShapeLines

_BLOCK = 8  # load cases at once
_NOWHERE = 1e-9  # of the largest shape: a sensor that no mode moves


def read_beam(path: FilePath) -> ReductionSource:
    """Read a beam and prepare its finite elements, modes and load cases.

    Forces act across the beam; one newton of a uniform force is spread over its whole length.
    Raises `ValueError` as `read_beam_description` does, and where the elements have no such modes
    or a sensor or force is at a place that none of them moves.
    """
    beam, file = read_beam_description(path), file_name(path)
    elements = _elements(beam)
    basis = elements.modes(beam.modes)
    frequency = np.asarray(basis.frequency)
    if not np.all(np.isfinite(frequency)):
        raise ValueError(f"[supports] of {file} leave a mechanism: its stiffness is singular.")
    shapes = np.asarray(basis.shapes)
    largest = np.max(np.abs(shapes[elements.translations]))
    sensors = {}
    for name, at in beam.sensors.items():
        sensors[name] = transverse_row(elements, at) @ shapes
        if not np.max(np.abs(sensors[name])) > _NOWHERE * largest:
            raise ValueError(f"[sensors] of {file} has `{name}` at {at:g}, where no mode moves.")
    if beam.force_at is None:
        participation = np.asarray(line_load(elements)) @ shapes
    else:
        participation = transverse_row(elements, beam.force_at) @ shapes
        if not np.max(np.abs(participation)) > _NOWHERE * largest:
            raise ValueError(f"[force] of {file} is at {beam.force_at:g}, where no mode moves.")

    def solve(force: Float[np.ndarray, "case mode"]) -> StaticCases:
        return _in_blocks(lambda rows: beam_static_cases(elements, basis, rows), force)

    stated = beam.damping_ratio
    note = f"no damping is stated: {ASSUMED_DAMPING:g} is taken for every mode"
    return ReductionSource(
        name=beam.name,
        basis=basis,
        damping_ratio=np.array(stated or (ASSUMED_DAMPING,) * len(beam.modes)),
        sensors=sensors,
        participation=participation,
        solve=solve,
        thickness=beam.thickness,
        load_scale=beam.load_scale,
        degree=beam.degree,
        lines=_lines(elements, basis),
        notes=() if stated is not None else (note,),
    )


def _in_blocks(solve: StaticSolver, force: Float[np.ndarray, "case mode"]) -> StaticCases:
    """Load cases by blocks of one size, so that one program serves any number of them."""
    count = len(force)
    rows = np.resize(np.arange(count), -(-count // _BLOCK) * _BLOCK)
    blocks = [solve(np.asarray(force)[part]) for part in rows.reshape(-1, _BLOCK)]
    found: StaticCases = jax.tree.map(lambda *parts: jnp.concatenate(parts)[:count], *blocks)
    return found


def _elements(beam: BeamDescription) -> CorotationalBeam:
    return corotational_beam(
        beam.length,
        RectangularSection(beam.width, beam.thickness, beam.young, beam.density),
        beam.supports,
        elements=beam.elements,
        radius=beam.radius,
    )


def _lines(elements: CorotationalBeam, basis: ReductionBasis) -> ShapeLines:
    x = np.asarray(elements.nodes)[:, 0]
    rows = [transverse_row(elements, k / (len(x) - 1)) for k in range(len(x))]
    return ShapeLines(x, np.array(rows) @ np.asarray(basis.shapes), "Position along the chord (m)")
