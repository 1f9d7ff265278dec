"""Geometrically nonlinear static load cases by CalculiX, in parallel and resumable."""

import io
import os
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.condense.load_cases import StaticCases
from snrmjax.io.calculix.deck import Deck
from snrmjax.io.calculix.jobs import (
    Calculix,
    JobOutcome,
    deck_digest,
    find_calculix,
    last_energy,
    model_file,
    printed_tables,
    run_job,
)
from snrmjax.io.calculix.modes import ALL_NODES, DeckModes, all_nodes, load_rows
from snrmjax.io.files import FilePath, write_atomically
from snrmjax.numerics.rules import InputError

CONVERGED, DIVERGED = "converged", "diverged"
KILLED, REFUSED = "killed", "refused"
STEP_OF_CASES = "*STEP, NLGEOM, INC=1000"
_ALL_ELEMENTS = "SNRMJAX_ELEMENTS"
# First and largest increment: a quarter of the load; CalculiX cuts back where it must.
_INCREMENTS = "0.25, 1., 1.e-5, 1."
# CalculiX's default residual of 0.5 % biases a cubic coefficient identified from small loads:
# tightened to 1e-8 of the mean force and of the largest correction.
_CONTROLS = "1.e-8, 1.e-8, 0.01, , 1.e-6, 1.e-8, 1.e-8, 1.e-10"
_END_OF_STEP = 1.0 - 1e-6

Progress = Callable[[int, int], None]
"""Called with the numbers of cases done and of all cases."""


class StaticRun(eqx.Module):
    """Load cases run by CalculiX, now or in an earlier run.

    `status` of a case: "converged"; "diverged", the load was not reached; "killed", the program was
    killed or ran into its time limit; "refused", the deck was not read. The next run tries
    those killed or refused again.
    `seconds` is the run time of CalculiX, in this run or in an earlier one.
    """

    cases: StaticCases
    status: tuple[str, ...] = eqx.field(static=True)
    seconds: Float[np.ndarray, " case"] = eqx.field(converter=np.asarray)
    errors: tuple[str, ...] = eqx.field(static=True, default=())  # messages of CalculiX, or empty
    found: int = eqx.field(static=True, default=0)  # cases whose stored result was reused


class _Result(NamedTuple):
    status: str
    displacement: Float[np.ndarray, " dof"]
    energy: float
    seconds: float
    error: str


def run_static_cases(
    modes: DeckModes,
    forces: Float[np.ndarray, "case mode"],
    folder: FilePath,
    *,
    names: Sequence[str] = (),
    workers: int | None = None,
    time_limit: float = 3600.0,
    program: str = "ccx",
    progress: Progress | None = None,
) -> StaticRun:
    """Run static load cases F = M Φ f with large displacements (NLGEOM), one job a case.

    Each job is identified by a digest of its deck: results in `folder` are reused; cases that are
    damaged or were killed run again. A case that did not converge is kept with its status.

    Arguments: `modes` by `modes_of_deck`; `forces` f, one row a case (kg^1/2 m/s²); `folder` for
    decks and results; `names` of the cases; `workers`, jobs at a time (one for each core, each on
    one thread); `time_limit` of a case (s); `program`; `progress` is called after each case.
    Returns a `StaticRun`. Raises `ValueError` where CalculiX is missing, forces have another
    number of modes, or no case could be run, with CalculiX's message. If all cases diverge, they
    are still returned.
    """
    forces = np.atleast_2d(np.asarray(forces, dtype=float))
    kept = len(modes.basis.numbers)
    if forces.shape[1] != kept or not np.all(np.isfinite(forces)):
        raise InputError(
            f"`forces` must be finite with {kept} columns, one for each mode, but has the shape "
            f"{forces.shape}."
        )
    calculix = find_calculix(program, time_limit)
    deck = modes.deck
    model = model_file(deck.text + all_nodes(deck) + _all_elements(deck), folder)
    steps = [_step(modes, row) for row in forces]
    paths = [model.parent / f"case-{deck_digest(model.name + step)}.npz" for step in steps]
    results = {path: result for path in paths if (result := _stored(path, deck)) is not None}
    todo = {path: step for path, step in zip(paths, steps, strict=True) if path not in results}
    known = sum(path in results for path in paths)
    with ThreadPoolExecutor(max_workers=workers or os.cpu_count() or 1) as pool:
        running = {
            pool.submit(_compute, calculix, model, step, path, modes): path
            for path, step in todo.items()
        }
        try:
            for done, future in enumerate(as_completed(running), start=1):
                results[running[future]] = future.result()
                if progress is not None:
                    progress(known + done, len(paths))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    rows = [results[path] for path in paths]
    if rows and all(row.status in (KILLED, REFUSED) for row in rows):
        raise InputError(f"CalculiX ran no load case of {deck.name}: {rows[0].error}.")
    displacement = np.array([row.displacement for row in rows]).reshape(len(rows), -1)
    # Like the displacement, the energy excludes the local compliance under the nodal loads.
    local = 0.5 * np.einsum("ci,ij,cj->c", forces, modes.residual_flexibility, forces)
    energy = np.array([row.energy for row in rows]) - local
    return StaticRun(
        StaticCases(
            force=jnp.asarray(forces),
            modal_displacement=jnp.asarray(modes.modal_displacement(displacement, forces)),
            converged=jnp.asarray([row.status == CONVERGED for row in rows], dtype=bool),
            energy=jnp.asarray(energy) if np.any(np.isfinite(energy)) else None,
            displacement=jnp.asarray(displacement),
            names=tuple(names),
        ),
        tuple(row.status for row in rows),
        np.array([row.seconds for row in rows]),
        tuple(row.error for row in rows),
        known,
    )


def _step(modes: DeckModes, force: Float[np.ndarray, " mode"]) -> str:
    """The step of one case: loads ramped up, displacements and energy printed at its end."""
    loads = np.asarray(modes.basis.filter).T @ force
    energy = [f"*EL PRINT, ELSET={_ALL_ELEMENTS}, TOTALS=ONLY", "ELSE"]
    return "\n".join(
        [
            *(STEP_OF_CASES, "*STATIC", _INCREMENTS),
            *("*CONTROLS, PARAMETERS=FIELD", _CONTROLS),
            *load_rows(modes.deck, loads),
            *(f"*NODE PRINT, NSET={ALL_NODES}", "U"),
            *(energy if _has_energy(modes.deck) else []),
            *("*END STEP", ""),
        ]
    )


def _has_energy(deck: Deck) -> bool:
    """Whether the printed element energies sum to the total energy (not for springs)."""
    return not any(kind.startswith("SPRING") for kind in deck.element_types)


def _all_elements(deck: Deck) -> str:
    labels = deck.elements
    rows = [labels[i : i + 8] for i in range(0, len(labels), 8)]
    return "\n".join(
        [f"*ELSET, ELSET={_ALL_ELEMENTS}", *(", ".join(map(str, row)) + "," for row in rows), ""]
    )


def _compute(calculix: Calculix, model: Path, step: str, path: Path, modes: DeckModes) -> _Result:
    """Run one case and store it unless it was killed or refused."""
    result = _case_result(run_job(calculix, model, step), modes.deck)
    if result.status not in (KILLED, REFUSED):
        content = io.BytesIO()
        np.savez(content, **result._asdict())
        write_atomically(path, content.getvalue())
    return result


def _case_result(outcome: JobOutcome, deck: Deck) -> _Result:
    """Status and results of a job: a displacement only where the full load was reached."""
    no_displacement = np.full(3 * len(deck.nodes), np.nan)
    failed = _Result(DIVERGED, no_displacement, np.nan, outcome.seconds, outcome.error)
    if not outcome.finished:
        return failed._replace(status=KILLED)
    if not outcome.started:
        return failed._replace(status=REFUSED, error=outcome.error or "no message")
    try:
        tables = list(printed_tables(outcome.dat, deck.nodes))
    except ValueError as error:
        return failed._replace(error=str(error))
    if outcome.error or not tables or tables[-1].time < _END_OF_STEP:
        return failed._replace(error=outcome.error or "the full load was not reached")
    energy, displacement = last_energy(outcome.dat), tables[-1].values.ravel()
    return _Result(
        CONVERGED, displacement, np.nan if energy is None else energy, outcome.seconds, ""
    )


def _stored(path: Path, deck: Deck) -> _Result | None:
    """The result of an earlier run; None where it is missing or damaged."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            numbers = file["displacement"], float(file["energy"]), float(file["seconds"])
            result = _Result(str(file["status"]), *numbers, str(file["error"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return result if result.displacement.shape == (3 * len(deck.nodes),) else None
