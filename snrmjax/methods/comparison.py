"""The methods that tables of steady states and time records allow, side by side."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.identify.inference.fitted_curves import as_backbone
from snrmjax.identify.inference.identification import identify_backbone
from snrmjax.identify.joint.joint_fit import fit_jointly
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states, with_levels_apart
from snrmjax.methods.record_comparison import RECORD_METHODS, run_record_method, states_of
from snrmjax.methods.records.recorded_test import RecordedTest, RecordKind, recorded_test
from snrmjax.methods.result import (
    MethodPoint,
    MethodResult,
    MethodStatus,
    method_result,
)
from snrmjax.methods.steady.arslan_ozguven import arslan_ozguven
from snrmjax.methods.steady.concerto import concerto
from snrmjax.methods.steady.harmonic_force_surface import harmonic_force_surface
from snrmjax.methods.steady.phase_resonance import phase_resonance
from snrmjax.methods.steady.rct import rct
from snrmjax.model.modes import LinearModes

_SAMPLES = 41  # of the curves that the inverse method gives

Method = Callable[[SteadyStates, LinearModes], MethodResult]


def snrm(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """The inverse single nonlinear resonant mode method: its curves at 41 amplitudes.

    `identify_backbone` in the form of the other methods; where the force is known only as a drive
    voltage `fit_jointly`, with the gain and the instrument's phase as unknowns. Arguments: `data`
    and `modes` as there. Returns a `MethodResult` between the smallest and the largest measured
    amplitude; 1σ as stated by the data or from the scatter about the curve.
    Raises `ValueError` as these do.
    Reference: Kwarta & Allen, section 2.2.
    """
    if np.isfinite(np.asarray(data.force)).any():
        found = identify_backbone(data, modes)
        backbone, notes = found.backbone, found.notes
    else:
        joint = fit_jointly(data, modes, free=("instrument_phase",))
        backbone, notes = as_backbone(joint), joint.notes
    curve = backbone.sampled(_SAMPLES)
    columns = (
        *(curve.velocity, curve.natural_frequency, curve.natural_frequency_std),
        *(curve.damping_ratio, curve.damping_ratio_std),
    )
    points = [
        MethodPoint(MethodStatus.FOUND, -1, *(float(value) for value in row))
        for row in np.stack([np.asarray(one) for one in columns], axis=1)
    ]
    return method_result("snrm", points, data.n_states, notes)


METHODS: dict[str, Method] = {
    "snrm": snrm,
    "concerto": concerto,
    "arslan_ozguven": arslan_ozguven,
    "rct": rct,
    "harmonic_force_surface": harmonic_force_surface,
    "phase_resonance": phase_resonance,
}
"""Methods that read a table of steady states, by name."""


class Comparison(NamedTuple):
    """What each method found, and what stopped those that could not run."""

    results: tuple[MethodResult, ...]
    stopped: dict[str, str]  # method: why
    data: SteadyStates | None = None  # of tables, stepped sines and slow sweeps
    records: tuple[str, ...] = ()  # what each time record was taken for, and why


def compare_methods(
    data: SteadyStates | Sequence[SteadyStates | TimeRecording],
    modes: LinearModes,
    methods: Sequence[str] | None = None,
) -> Comparison:
    """Run several methods on the same tests.

    Arguments: `data` are steady states, or a list of steady states and time records of one
    structure. Records are sorted by what they are (`recorded_test` states the rules): stepped
    sines and slow sweeps become steady states, free decays and broadband records go to the
    methods of records. Levels of different tests are kept apart. `methods` are names in `METHODS`
    and `RECORD_METHODS`; by default all that read data of these kinds. A method that the data do
    not allow is in `stopped` with the reason; the others still run.
    Raises `ValueError` for a name that no method has, and where not one method could run
    or found anything.
    """
    every = (*METHODS, *RECORD_METHODS)
    names = list(every) if methods is None else list(methods)
    unknown = [name for name in names if name not in every]
    if unknown:
        raise ValueError(
            f"`methods` must be among {', '.join(every)}, but has {', '.join(unknown)}."
        )
    parts = [data] if isinstance(data, SteadyStates) else list(data)
    tests, unread = _sorted_records(parts, modes)
    states, read, unsteady = _all_states(parts, tests)
    results: list[MethodResult] = []
    stopped: dict[str, str] = {}
    absent: dict[str, str] = {}
    for name in names:
        if name in RECORD_METHODS:
            found = run_record_method(name, tests, modes)
            if found.result is not None:
                results.append(found.result)
            else:
                (stopped if found.had_data else absent)[name] = found.reason
        elif states is None:
            why = f"{name} needs steady states, and the data have none."
            (stopped if unsteady else absent)[name] = f"{name}: {unsteady[0]}" if unsteady else why
        else:
            try:
                results.append(METHODS[name](states, modes))
            except ValueError as error:
                stopped[name] = str(error)
    for why in unread:  # a record that nothing can use stops what has no other data
        for name in absent:
            stopped[name] = f"{name}: {why}"
        absent = {}
    if not results:
        first, reason = next(iter((stopped | absent).items()), ("none", "none was asked for."))
        own = reason if reason.startswith(first) else f"{first}: {reason}"
        raise ValueError(f"no method could run; {own}")
    if not any(one.found.any() for one in results):
        why = MethodStatus(int(results[0].status[0])).message
        raise ValueError(f"no method found anything; {results[0].method}: {why}.")
    left_out = [f"left out: {why}" for why in (*unread, *unsteady)]
    return Comparison(tuple(results), stopped | absent, states, (*_kinds(tests, read), *left_out))


def _kinds(tests: Sequence[RecordedTest], read: dict[int, str]) -> list[str]:
    """What each record was taken for, why, and how many states it gave."""
    return [
        f"{one.recording.name}: {one.kind.value} ({one.why}"
        + (f"; {read[k]})" if k in read else ")")
        for k, one in enumerate(tests)
    ]


def _sorted_records(
    parts: Sequence[SteadyStates | TimeRecording], modes: LinearModes
) -> tuple[list[RecordedTest], list[str]]:
    """Records by what they are, and why some are nothing."""
    tests, unread = [], []
    for one in parts:
        if isinstance(one, TimeRecording):
            try:
                tests.append(recorded_test(one, modes))
            except ValueError as error:
                unread.append(str(error))
    return tests, unread


def _all_states(
    parts: Sequence[SteadyStates | TimeRecording], tests: Sequence[RecordedTest]
) -> tuple[SteadyStates | None, dict[int, str], list[str]]:
    """Steady states of tables, steps and sweeps, how many by record, and why some have none."""
    found, why = [one for one in parts if isinstance(one, SteadyStates)], []
    read: dict[int, str] = {}
    for k, test in enumerate(tests):
        if test.kind in (RecordKind.STEPPED_SINE, RecordKind.SLOW_SWEEP):
            try:
                states, read[k] = states_of(test)
                found.append(states)
            except ValueError as error:
                why.append(str(error))
    if not found:
        return None, read, why
    return found[0] if len(found) == 1 else join_steady_states(with_levels_apart(found)), read, why
