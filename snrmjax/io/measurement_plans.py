"""Measurement plans as tables to be filled in, and reading of the completed ones."""

import json

import numpy as np

from snrmjax.diagnose.diagnosis_result import FormerAnswer
from snrmjax.diagnose.measurement_plan import MeasurementPlan
from snrmjax.io.columns import PHASOR, harmonic_columns, read_header
from snrmjax.io.files import FilePath, file_name, read_text, shown
from snrmjax.io.rows import read_cells
from snrmjax.io.tables import read_steady_states, write_table
from snrmjax.measure.states import SteadyStates, join_steady_states
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ

_DIGITS = 6  # of planned numbers


def write_plan(path: FilePath, plan: MeasurementPlan) -> None:
    """Write a plan as a CSV of steady states whose measured columns are empty.

    One row a state and sensor, with the planned level, frequency and force (or drive voltage);
    correct them where the test deviates. To be filled in: the velocity phasor and, where harmonics
    are requested, theirs. Standard deviations are those of the previous test.
    """
    states = plan.states
    state, sensor = np.nonzero(np.asarray(states.measured))
    empty = [""] * len(state)
    volts = bool(np.isfinite(np.asarray(states.drive)).all())
    load = ("drive_v", states.drive) if volts else ("force_n", states.force)
    columns: dict[str, list] = {
        "level": np.asarray(states.level)[state].tolist(),
        "sensor": [states.sensors[k] for k in sensor],
        "frequency_hz": _numbers(np.asarray(states.frequency)[state] / HERTZ),
        load[0]: _numbers(np.asarray(load[1])[state]),
    }
    if len(states.sensors) == 1:
        del columns["sensor"]
    columns |= dict.fromkeys(PHASOR, empty)
    for order in plan.harmonics:
        columns |= dict.fromkeys(harmonic_columns(order), empty)
    if plan.harmonics:
        floor = "" if plan.harmonic_std is None else format(plan.harmonic_std, ".3g")
        columns["harmonic_std_m_s"] = [floor] * len(state)
    stated = {
        "velocity_std_m_s": np.asarray(states.velocity_std)[state, sensor],
        "phase_std_deg": np.asarray(states.phase_std)[state, sensor] / DEGREE,
        "force_std_n": np.asarray(states.force_std)[state],
        "order": np.asarray(states.order)[state],
    }
    for name, values in stated.items():
        if np.isfinite(values).any() and not (volts and name == "force_std_n"):
            columns[name] = _numbers(values, 3)
    write_table(path, columns)


def _numbers(values: np.ndarray, digits: int = _DIGITS) -> list[str]:
    return [format(value, f".{digits}g") if np.isfinite(value) else "" for value in values.tolist()]


def read_further_states(path: FilePath, model: Structure, first: SteadyStates) -> SteadyStates:
    """The states of a test with further ones of the same structure, such as a filled plan.

    Raises `ValueError` where a velocity or a harmonic is not filled in, naming its row and
    column; where one has forces and the other drive voltages; and what `read_steady_states` raises.
    """
    _check_filled(path)
    further = read_steady_states(path, model)
    volts = [bool(np.isfinite(np.asarray(part.drive)).any()) for part in (first, further)]
    if volts[0] != volts[1]:
        names = ["`drive_v`" if volt else "`force_n`" for volt in volts]
        raise InputError(
            f"further states must have the column {names[0]} as the first ones have, but "
            f"{file_name(path)} has {names[1]}."
        )
    return join_steady_states(first, further)


def _check_filled(path: FilePath) -> None:
    """Refuse a table with an empty field in a measured column."""
    cells = read_cells(path)
    header = read_header(cells)
    cells.require_rows()
    std = ("harmonic_std_m_s",) if header.harmonics else ()
    for name in (*PHASOR, *header.harmonics, *std):
        for number, text in enumerate(cells.texts(name) if name in header.used else ()):
            if text == "":
                raise cells.refusal(name, "filled in with what was measured", number)


def read_former_answer(path: FilePath) -> FormerAnswer:
    """The answer in a `diagnosis.json`, for comparison with a diagnosis of more states.

    Raises `ValueError` for a file not written by `snrmjax diagnose`.
    """
    file, text = file_name(path), read_text(path)
    try:
        answer = json.loads(text)
        probabilities = {
            tuple(name.split("+")): float(p) for name, p in answer["probabilities"].items()
        }
        return FormerAnswer(str(answer["verdict"]), tuple(answer["effects"]), probabilities)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            f"{file} must be a diagnosis.json that `snrmjax diagnose` wrote, but is none "
            f"({shown(str(error))})."
        ) from error
