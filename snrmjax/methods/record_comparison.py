"""Methods for time records: resonant decay, restoring force, submanifold, state space."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from snrmjax.measure.decays.decay_record import even_record
from snrmjax.measure.decays.isolated_decay import IsolatedDecay
from snrmjax.measure.recordings.stepped_sine import stepped_sine_states
from snrmjax.measure.states import SteadyStates
from snrmjax.measure.sweeps.slow_sweep import sweep_states
from snrmjax.methods.records.pnlss import pnlss
from snrmjax.methods.records.recorded_decays import (
    read_decays,
    recorded_decays,
    restoring_force_of_mode,
    ssm_of_mode,
)
from snrmjax.methods.records.recorded_test import RecordedTest, RecordKind
from snrmjax.methods.records.recorded_velocity import recorded_velocity
from snrmjax.methods.records.resonant_decay import decay_of_mode
from snrmjax.methods.records.restoring_force import restoring_force
from snrmjax.methods.result import MethodResult, method_result
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_LONGEST = 2**22  # samples of a record that these methods keep in memory


class MethodRun(NamedTuple):
    """A method's result for all records of its kinds, or why it has none."""

    result: MethodResult | None
    reason: str
    had_data: bool = True  # records of its kinds were present


def states_of(test: RecordedTest) -> tuple[SteadyStates, Fact]:
    """Steady states of a stepped sine or a slow sweep at the model's sensors, and their number.

    Raises `ValueError`, with the record's name, as `stepped_sine_states` and `sweep_states` do.
    """
    channels = test.channels
    force = channels.force or channels.drive
    if force is None:
        raise InputError(f"{test.recording.name} has no force.")
    drive = channels.drive if channels.force is not None else None
    settings: dict[str, Any] = {"sensors": channels.sensors, "drive": drive}
    try:
        if test.kind is RecordKind.STEPPED_SINE:
            steps = stepped_sine_states(test.recording, force, channels.motions, **settings)
            states = steps.states
            return states, Fact("steps_settled", n=states.n_states, n_steps=len(steps.status))
        states = sweep_states(test.recording, force, channels.motions, **settings).states
        return states, Fact("states_read", n=states.n_states)
    except InputError as error:
        raise InputError.located(test.recording.name, error) from error


def with_decays(test: RecordedTest, modes: LinearModes) -> RecordedTest:
    """The record with the isolated mode of each free decay, shared by the methods."""
    if test.recording.n_samples > _LONGEST:
        return test
    return test._replace(decays=recorded_decays(test, modes))


def _of_decays(
    method: Callable[[IsolatedDecay], MethodResult],
) -> Callable[[RecordedTest, LinearModes], list[MethodResult]]:
    def run(test: RecordedTest, modes: LinearModes) -> list[MethodResult]:
        return read_decays(method, recorded_decays(test, modes))

    return run


def _with_notes(result: MethodResult, notes: Sequence[Fact]) -> MethodResult:
    return dataclasses.replace(result, notes=(*result.notes, *notes))


def _restoring_force(test: RecordedTest, modes: LinearModes) -> list[MethodResult]:
    if test.kind is RecordKind.FREE_DECAY:
        return _of_decays(restoring_force_of_mode)(test, modes)
    channel, whole = _force_channel(test), (0, test.recording.n_samples)
    motion = recorded_velocity(test.recording, test.channels.reference, test.frequency, whole)
    force = test.recording.values([channel], motion.start, motion.start + len(motion.time))[0]
    result = restoring_force(
        motion.time, motion.velocity, even_record(motion.time, force)[1], modes
    )
    return [_with_notes(result, motion.notes)]


def _force_channel(test: RecordedTest) -> str:
    if test.channels.force is None:
        raise InputError("a forced record needs its force in N (force_n).")
    return test.channels.force


def _pnlss_of(tests: Sequence[RecordedTest], modes: LinearModes) -> MethodResult:
    """One model for all realisations and levels; the second largest is left for validation."""
    if len({(test.channels, test.recording.sampling_rate) for test in tests}) > 1:
        raise InputError("records of different channels or rates are fitted one by one.")
    force = _force_channel(tests[0])
    records = [test.recording for test in tests]
    if len(records) == 1:
        return pnlss(records, force, tests[0].channels.reference, modes)
    force_rms = [float(np.std(record.values([force], 0, _LONGEST))) for record in records]
    first, second, *others = np.argsort(force_rms)[::-1]
    ordered = [records[k] for k in (first, *others, second)]
    result = pnlss(ordered, force, tests[0].channels.reference, modes)
    return _with_notes(result, [Fact("one_model_of_records", n=len(tests))])


class RecordMethod(NamedTuple):
    """A method, the kinds of record it accepts, and its function for several records at once."""

    run: Callable[[RecordedTest, LinearModes], list[MethodResult]]
    kinds: tuple[RecordKind, ...]
    together: Callable[[Sequence[RecordedTest], LinearModes], MethodResult] | None = None


RECORD_METHODS: dict[str, RecordMethod] = {
    "resonant_decay": RecordMethod(_of_decays(decay_of_mode), (RecordKind.FREE_DECAY,)),
    "restoring_force": RecordMethod(
        _restoring_force, (RecordKind.FREE_DECAY, RecordKind.BROADBAND)
    ),
    "ssm": RecordMethod(_of_decays(ssm_of_mode), (RecordKind.FREE_DECAY,)),
    "pnlss": RecordMethod(
        lambda test, modes: [_pnlss_of([test], modes)], (RecordKind.BROADBAND,), _pnlss_of
    ),
}
"""Methods for time records, by name."""


def run_record_method(name: str, tests: Sequence[RecordedTest], modes: LinearModes) -> MethodRun:
    """Run one of `RECORD_METHODS` on all records of its kinds, as one result.

    Where the method can, all records are fitted together; where that fails a note gives the reason
    and they are fitted one by one. A rejected record is named in a note, or in the reason where
    all are rejected.
    """
    method = RECORD_METHODS[name]
    readable = [test for test in tests if test.kind in method.kinds]
    if not readable:
        wanted = " or ".join(kind.value for kind in method.kinds)
        return MethodRun(
            None, f"a time record ({wanted}) is needed, and the data have none.", False
        )
    results: list[MethodResult] = []
    reasons: list[str] = []
    apart: list[Fact] = []
    read: list[RecordedTest] = []
    if method.together is not None and len(readable) > 1:
        try:
            results, read, readable = [method.together(readable, modes)], readable, []
        except (InputError, np.linalg.LinAlgError) as error:
            apart = [Fact("records_apart", why=str(error))]
    for test in readable:
        try:
            if test.recording.n_samples > _LONGEST:
                raise InputError(f"the record has more than {_LONGEST} samples: cut it.")
            results += method.run(test, modes)
            read.append(test)
        except (InputError, np.linalg.LinAlgError) as error:
            reasons.append(str(InputError.located(test.recording.name, error)))
    if not results:
        return MethodRun(None, reasons[0])
    notes = [
        *(Fact("record_left_out", why=why) for why in reasons),
        *(note for result in results for note in result.notes),
        *apart,
    ]
    # The record's number is the level.
    points = [
        point._replace(level=number)
        for number, result in enumerate(results, 1)
        for point in result.points()
    ]
    seconds = sum(test.recording.duration for test in read)
    return MethodRun(method_result(name, points, 0, notes, test_seconds=seconds), "")
