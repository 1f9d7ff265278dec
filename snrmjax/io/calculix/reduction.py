"""A CalculiX deck as the source of a reduced-order model."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from snrmjax.condense.load_cases import StaticCases
from snrmjax.condense.reduction import ASSUMED_DAMPING, ReductionSource, ShapeLines
from snrmjax.io.calculix.deck import Deck, read_deck
from snrmjax.io.calculix.modes import DeckModes, modes_of_deck
from snrmjax.io.calculix.static import STEP_OF_CASES, run_static_cases
from snrmjax.io.files import FilePath
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

NodeDirection = tuple[int, str]
"""A node's number and a direction, "x", "y" or "z"."""


def read_deck_source(
    path: FilePath,
    numbers: Sequence[int],
    folder: FilePath | None = None,
    *,
    sensors: Mapping[str, NodeDirection] | None = None,
    force: NodeDirection | None = None,
    program: str = "ccx",
    time_limit: float = 3600.0,
    progress: Callable[[int, int], None] | None = None,
) -> ReductionSource:
    """Read a deck, compute its modes and prepare its load cases, all by CalculiX.

    Jobs and their results are kept in `folder` (`<deck>.jobs` next to the deck) and reused by later
    runs of the same deck with any modes and loads.

    Arguments: `path` of the deck; `numbers` of the modes to keep, from one; `sensors` by name and
    `force` (one newton) as (node, direction): by default both are where the first mode
    is largest; `program`, `time_limit` (s) and `progress` as for `run_static_cases`.
    Raises `ValueError` as `read_deck` and `modes_of_deck` do, and then leaves no folder behind.
    """
    deck = read_deck(path)
    job_folder = Path(path).with_suffix(".jobs") if folder is None else Path(folder)
    try:
        modes = modes_of_deck(deck, numbers, job_folder, program=program, time_limit=time_limit)
    except InputError:
        _remove_unused(job_folder)
        raise
    largest = _largest(modes)
    positions = dict(sensors) if sensors else {f"node {largest[0]} {largest[1]}": largest}
    drive = force or largest

    def solve(forces: Float[np.ndarray, "case mode"]) -> StaticCases:
        return run_static_cases(
            modes, forces, job_folder, time_limit=time_limit, program=program, progress=progress
        ).cases

    return ReductionSource(
        name=Path(path).stem,
        basis=modes.basis,
        damping_ratio=np.full(len(modes.basis.numbers), ASSUMED_DAMPING),
        sensors={name: modes.shape_at(*at) for name, at in positions.items()},
        participation=modes.shape_at(*drive),
        solve=solve,
        thickness=deck.thickness,
        lines=_lines(modes),
        notes=_notes(deck, drive, forced=force is not None),
    )


def _notes(deck: Deck, drive: NodeDirection, *, forced: bool) -> tuple[Fact, ...]:
    notes = [Fact("damping_assumed", ratio=ASSUMED_DAMPING)]
    if not forced:
        notes.append(Fact("driven_at_largest", node=drive[0], direction=drive[1]))
    if deck.small_displacements:
        notes.append(Fact("large_displacements_taken", step=STEP_OF_CASES))
    if deck.left_out:
        notes.append(Fact("loads_left_out", keywords=deck.left_out))
    return tuple(notes)


def _largest(modes: DeckModes) -> NodeDirection:
    """Node and direction of the largest displacement of the first mode kept."""
    first = np.asarray(modes.basis.shapes)[:, 0]
    node, direction = divmod(int(np.argmax(np.abs(first))), 3)
    return int(modes.deck.nodes[node]), "xyz"[direction]


def _lines(modes: DeckModes) -> ShapeLines | None:
    """Shapes along the axis of a structure of beam elements; None for other elements."""
    if not all(kind.startswith("B") for kind in modes.deck.element_types):
        return None
    coordinates = modes.deck.coordinates
    along = int(np.argmax(np.ptp(coordinates, axis=0)))
    order = np.argsort(coordinates[:, along])
    across = "xyz".index(_largest(modes)[1])
    shape = np.asarray(modes.basis.shapes)[across::3][order]
    return ShapeLines(coordinates[order, along], shape, f"Position along {'xyz'[along]} (m)")


def _remove_unused(job_folder: Path) -> None:
    """Remove a folder of jobs without any result."""
    if job_folder.is_dir() and not any(job_folder.glob("case-*")):
        for model in job_folder.glob("model-*.inp"):
            model.unlink()
        if not any(job_folder.iterdir()):
            job_folder.rmdir()
