"""The import doctor: looks at tables, model and time records before anything is identified."""

from collections.abc import Sequence

import numpy as np

from snrmjax.doctor.balance_fit import as_recorded, best_balance
from snrmjax.doctor.findings import Checkup, Finding, gravest_first
from snrmjax.doctor.force_checks import dropout_findings, harmonic_findings
from snrmjax.doctor.mode_checks import mode_findings
from snrmjax.doctor.mode_states import (
    files_of_levels,
    leading_sensor,
    mode_states,
    usable_rows,
)
from snrmjax.doctor.record_checks import record_findings
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states
from snrmjax.model.structures import Structure

FEWEST = 8  # states: fewer say nothing of a mode with curves of its own


def check_test(
    tables: SteadyStates | Sequence[SteadyStates],
    model: Structure | None = None,
    recordings: Sequence[TimeRecording] = (),
) -> Checkup:
    """Find errors of import and of the test in tables and records, before identification.

    Near resonance a single mode obeys iΩAF/V = κ(K(a) − Ω² + iΩD(a)), with smooth K and D of the
    displacement amplitude. What the columns are taken for, or one thing that may have gone wrong
    with them, is corrected, and its likelihood compared with that of the table as it is; κ, the
    modal mass over the model's, says whether force, response and shape have one scale. Records
    are looked at step by step: limits, transients, harmonics of the force, folded frequencies.

    Arguments: `tables` of one structure, each a test of its own (in the order of time); `model` as
    for identification, without which scales and the model's frequency are not looked at;
    `recordings` of the same test.
    Returns `Checkup`: `.findings`, each with kind, severity ("error", "warning", "info"), where,
    evidence and what mends it; none where all is well; `.notes` on what could not be looked at.
    Raises `ValueError` for nothing to look at and for tables of different sensors.
    Validity: one well-separated mode and tests near its resonance; at least eight states. A
    factor of the force and the same one of the modal mass look alike in one table: both are named
    then.

    >>> from snrmjax.measure import steady_states
    >>> w = np.linspace(480.0, 520.0, 30)
    >>> v = 1j * w / (500.0**2 - w**2 + 10j * w)
    >>> check_test(steady_states(np.ones(30), w, np.ones(30), v.conj())).kinds
    ('conjugated_response',)
    """
    given = [tables] if isinstance(tables, SteadyStates) else list(tables)
    if not given and not recordings:
        raise ValueError("there is nothing to check: give a table or a recording.")
    found: list[Finding] = []
    notes: list[str] = []
    if given:
        parts, groups = files_of_levels(given)
        data = parts[0] if len(parts) == 1 else join_steady_states(parts)
        found += _of_table(data, model, groups if len(parts) > 1 else (), notes)
    else:
        notes.append("no table of steady states: columns and scales were not looked at.")
    if given and model is None:
        notes.append("no model: the scale of force, response and shape was not looked at.")
    for one in recordings:
        own, said = record_findings(one)
        found += own
        notes += said
    return Checkup(gravest_first(_once(found)), tuple(dict.fromkeys(notes)))


def _of_table(
    data: SteadyStates,
    model: Structure | None,
    groups: tuple[tuple[int, ...], ...],
    notes: list[str],
) -> list[Finding]:
    sensor = leading_sensor(data)
    rows = usable_rows(data, sensor)
    name = data.sensors[sensor]
    n_levels = len(given_levels(data))
    where = f"{n_levels} level{'s' if n_levels != 1 else ''} at {name}"
    if rows.sum() < FEWEST:
        notes.append(
            f"{int(rows.sum())} states with force and phase at {name} are too few to look at: "
            f"{FEWEST} are needed."
        )
        return []
    drive = bool(np.all(np.isnan(np.asarray(data.force)[rows])))
    if drive:
        notes.append("the force is declared as a drive voltage: its scale was not looked at.")
    states = mode_states(data, model, sensor, rows)
    found = mode_findings(states, model, where, groups, drive)
    found += dropout_findings(states, where)
    if data.harmonic_order and not any(one.severity == "error" for one in found):
        fit = best_balance(states, as_recorded(states))
        found += harmonic_findings(data, states, fit, model, sensor, where)
    return found


def given_levels(data: SteadyStates) -> tuple[int, ...]:
    """Numbers of the levels of a table."""
    return tuple(int(k) for k in np.unique(np.asarray(data.level)))


def _once(found: Sequence[Finding]) -> list[Finding]:
    """One finding of each kind and place."""
    return list({(one.kind, one.where): one for one in reversed(found)}.values())[::-1]
