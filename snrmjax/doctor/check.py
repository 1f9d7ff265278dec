"""The import doctor: looks at tables, model and time records before anything is identified."""

from collections.abc import Sequence

import numpy as np

from snrmjax.doctor.checked_states import (
    checked_states,
    files_of_levels,
    leading_sensor,
    usable_rows,
)
from snrmjax.doctor.findings import Checkup, Finding, gravest_first
from snrmjax.doctor.force_checks import dropout_findings, harmonic_findings
from snrmjax.doctor.priors import FEWEST_STATES
from snrmjax.doctor.record_checks import record_findings
from snrmjax.doctor.table_check import mode_findings
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states
from snrmjax.model.structures import Structure


def check_test(
    tables: SteadyStates | Sequence[SteadyStates],
    model: Structure | None = None,
    recordings: Sequence[TimeRecording] = (),
) -> Checkup:
    """Find errors of import and of the test in tables and records, before identification.

    Near resonance a single mode obeys iΩAF/V = κ(K(a) − Ω² + iΩδ(a)) with smooth curves of the
    displacement amplitude, whatever they are. Each thing that the columns may be taken for, or that
    may have gone wrong with the test, is undone and judged by the same posterior as the table as it
    is (`identify.test_model`): it is named only where one mode fits then, and clearly not as
    recorded. Records are looked at step by step: limits, transients, harmonics, folded frequencies.

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
    if rows.sum() < FEWEST_STATES:
        notes.append(
            f"{int(rows.sum())} states with force and phase at {name} are too few to look at: "
            f"{FEWEST_STATES} are needed."
        )
        return []
    drive = bool(np.all(np.isnan(np.asarray(data.force)[rows])))
    if drive:
        notes.append("the force is declared as a drive voltage: its scale was not looked at.")
    seen = checked_states(data, model, sensor, rows, groups)
    found, fit = mode_findings(seen, model, where, drive)
    found += dropout_findings(seen, where)
    if data.harmonic_order and not any(one.severity == "error" for one in found):
        found += harmonic_findings(data, seen, fit, model, sensor, where)
    return found


def given_levels(data: SteadyStates) -> tuple[int, ...]:
    """Numbers of the levels of a table."""
    return tuple(int(k) for k in np.unique(np.asarray(data.level)))


def _once(found: Sequence[Finding]) -> list[Finding]:
    """One finding of each kind and place."""
    return list({(one.kind, one.where): one for one in reversed(found)}.values())[::-1]
