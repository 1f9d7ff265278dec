"""The methods that a time record allows: decays, restoring forces, manifolds."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.measure.recordings.stepped_sine import stepped_sine_states
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates
from snrmjax.measure.sweeps.slow_sweep import sweep_states
from snrmjax.methods.records.pnlss import pnlss
from snrmjax.methods.records.recorded_test import RecordedTest, RecordKind
from snrmjax.methods.records.recorded_velocity import RecordedVelocity, recorded_velocity
from snrmjax.methods.records.resonant_decay import even_record, resonant_decay
from snrmjax.methods.records.restoring_force import restoring_force
from snrmjax.methods.records.ssm import ssm
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.model.modes import LinearModes

_LONGEST = 2**22  # samples of a record that these methods hold in memory


class Found(NamedTuple):
    """A method's answer to all records of its kind, or why it has none."""

    result: MethodResult | None
    reason: str
    had_data: bool = True  # records of the kind that it reads


def states_of(test: RecordedTest) -> tuple[SteadyStates, str]:
    """Steady states of a stepped sine or a slow sweep at the model's sensors, and how many.

    Raises `ValueError` that names the record for what `stepped_sine_states` and `sweep_states`
    refuse.
    """
    channels = test.channels
    force = channels.force or channels.drive
    if force is None:
        raise ValueError(f"{test.recording.name} has no force.")
    drive = channels.drive if channels.force is not None else None
    try:
        if test.kind is RecordKind.STEPPED_SINE:
            steps = stepped_sine_states(
                test.recording, force, channels.motions, sensors=channels.sensors, drive=drive
            )
            return steps.states, f"{steps.states.n_states} of {len(steps.status)} settled"
        swept = sweep_states(
            test.recording, force, channels.motions, sensors=channels.sensors, drive=drive
        ).states
        return swept, f"{swept.n_states} states read"
    except ValueError as error:
        raise ValueError(f"{test.recording.name}: {error}") from error


def _decays(test: RecordedTest) -> list[RecordedVelocity]:
    return [
        recorded_velocity(test.recording, test.channels.reference, test.frequency, part)
        for part in test.free
    ]


def _of_decays(
    method: Callable[..., MethodResult],
) -> Callable[[RecordedTest, LinearModes], list[MethodResult]]:
    def run(test: RecordedTest, modes: LinearModes) -> list[MethodResult]:
        found = []
        for one in _decays(test):
            seen = method(one.time, one.velocity, least_amplitude=one.floor)
            found.append(_noted(seen, one.notes))
        return found

    return run


def _noted(result: MethodResult, notes: Sequence[str]) -> MethodResult:
    return dataclasses.replace(result, notes=(*result.notes, *notes))


def _restoring_force(test: RecordedTest, modes: LinearModes) -> list[MethodResult]:
    if test.kind is RecordKind.FREE_DECAY:
        return _of_decays(restoring_force)(test, modes)
    if test.channels.force is None:
        raise ValueError("a forced record needs its force in N (force_n).")
    whole = (0, test.recording.n_samples)
    seen = recorded_velocity(
        test.recording, test.channels.reference, test.frequency, whole, forced=True
    )
    force = _force(test.recording, test.channels.force, seen)
    found = restoring_force(seen.time, seen.velocity, force, modes)
    return [_noted(found, seen.notes)]


def _force(
    recording: TimeRecording, name: str, seen: RecordedVelocity
) -> Float[np.ndarray, " sample"]:
    """The force at the samples of a velocity."""
    force = recording.values([name], seen.start, seen.start + len(seen.time))[0]
    return even_record(seen.time, force, f"channel {name}")[1]


class RecordMethod(NamedTuple):
    """A method, the kinds of record that it reads, and how it reads several as one test."""

    run: Callable[[RecordedTest, LinearModes], list[MethodResult]]
    kinds: tuple[RecordKind, ...]
    together: Callable[[Sequence[RecordedTest], LinearModes], list[MethodResult]] | None = None


def _pnlss(test: RecordedTest, modes: LinearModes) -> list[MethodResult]:
    return [_pnlss_of([test], modes)]


def _pnlss_of(tests: Sequence[RecordedTest], modes: LinearModes) -> MethodResult:
    records, force = [one.recording for one in tests], _force_channel(tests[0])
    return pnlss(records, force, tests[0].channels.reference, modes)


def _force_channel(test: RecordedTest) -> str:
    if test.channels.force is None:
        raise ValueError("the force must be known in N (force_n).")
    return test.channels.force


def _pnlss_together(tests: Sequence[RecordedTest], modes: LinearModes) -> list[MethodResult]:
    """One model of all realisations and levels; the one next to the largest is predicted."""
    if len({(one.channels, one.recording.sampling_rate) for one in tests}) > 1:
        raise ValueError("records of different channels or rates are fitted one by one.")
    force = _force_channel(tests[0])
    size = [float(np.std(one.recording.values([force], 0, _LONGEST))) for one in tests]
    first, second, *others = np.argsort(size)[::-1]
    found = _pnlss_of([tests[k] for k in (first, *others, second)], modes)
    return [_noted(found, (f"one model of {len(tests)} records",))]


RECORD_METHODS: dict[str, RecordMethod] = {
    "resonant_decay": RecordMethod(_of_decays(resonant_decay), (RecordKind.FREE_DECAY,)),
    "restoring_force": RecordMethod(
        _restoring_force, (RecordKind.FREE_DECAY, RecordKind.BROADBAND)
    ),
    "ssm": RecordMethod(_of_decays(ssm), (RecordKind.FREE_DECAY,)),
    "pnlss": RecordMethod(_pnlss, (RecordKind.BROADBAND,), _pnlss_together),
}
"""Methods that read time records, by name."""


def run_record_method(name: str, tests: Sequence[RecordedTest], modes: LinearModes) -> Found:
    """Run one of `RECORD_METHODS` on all records of its kinds, as one result.

    Where the method can, records are read as one test; where that fails a note says why, and they
    are read one by one. A record that it cannot read is named in a note, or in the reason where it
    can read none.
    """
    method = RECORD_METHODS[name]
    own = [one for one in tests if one.kind in method.kinds]
    if not own:
        wanted = " or ".join(kind.value for kind in method.kinds)
        return Found(None, f"{name} needs a time record ({wanted}), and the data have none.", False)
    found: list[MethodResult] = []
    reasons: list[str] = []
    seconds = 0.0
    apart: tuple[str, ...] = ()
    if method.together is not None and len(own) > 1:
        try:
            found = method.together(own, modes)
            seconds = sum(one.recording.duration for one in own)
            own = []
        except ValueError as error:
            apart = (f"each record alone: {error}",)
    for test in own:
        try:
            if test.recording.n_samples > _LONGEST:
                raise ValueError(f"the record has more than {_LONGEST} samples: cut it.")
            found += method.run(test, modes)
            seconds += test.recording.duration
        except ValueError as error:
            said = str(error)
            named = said if said.startswith(name) else f"{name}: {said}"
            reasons.append(f"{named} ({test.recording.name})")
    if not found:
        return Found(None, reasons[0])
    return Found(_noted(_joined(name, found, reasons, seconds), apart), "")


def _joined(
    name: str, found: Sequence[MethodResult], reasons: Sequence[str], seconds: float
) -> MethodResult:
    """Several results of one method as one, the number of the record as level."""
    points = [
        MethodPoint(
            MethodStatus(int(one.status[k])),
            number,
            *(
                float(column[k])
                for column in (
                    *(one.velocity, one.natural_frequency, one.natural_frequency_std),
                    *(one.damping_ratio, one.damping_ratio_std),
                )
            ),
        )
        for number, one in enumerate(found, 1)
        for k in range(len(one.status))
    ]
    notes = [note for one in found for note in one.notes]
    left_out = [f"a record was left out: {why}" for why in reasons]
    return method_result(name, points, 0, (*left_out, *notes), test_seconds=seconds)
