"""Run all methods that tables of steady states and time records allow, and compare them."""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from snrmjax.identify.inference.fitted_curves import as_backbone
from snrmjax.identify.inference.identification import identify_backbone
from snrmjax.identify.joint.joint_fit import fit_jointly
from snrmjax.measure.decays.decay_record import even_record
from snrmjax.measure.decays.isolated_decay import IsolatedDecay
from snrmjax.measure.recordings.stepped_sine import stepped_sine_states
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states, with_levels_apart
from snrmjax.measure.sweeps.slow_sweep import sweep_states
from snrmjax.methods.records.pnlss import pnlss
from snrmjax.methods.records.recorded_decays import (
    read_decays,
    recorded_decays,
    recorded_velocity,
    restoring_force_of_mode,
    ssm_of_mode,
)
from snrmjax.methods.records.recorded_test import RecordedTest, RecordKind, recorded_test
from snrmjax.methods.records.resonant_decay import decay_of_mode
from snrmjax.methods.records.restoring_force import restoring_force
from snrmjax.methods.result import (
    MethodResult,
    MethodStatus,
    method_result,
    points_of_curves,
)
from snrmjax.methods.steady.arslan_ozguven import arslan_ozguven
from snrmjax.methods.steady.concerto import concerto
from snrmjax.methods.steady.harmonic_force_surface import harmonic_force_surface
from snrmjax.methods.steady.phase_resonance import phase_resonance
from snrmjax.methods.steady.rct import rct
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_LONGEST = 2**22  # samples of a record that these methods keep in memory
_log = logging.getLogger(__name__)

_SAMPLES = 41  # amplitudes at which the inverse method's curves are evaluated

Method = Callable[[SteadyStates, LinearModes], MethodResult]


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


def snrm(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """The inverse single nonlinear resonant mode method: its curves at 41 amplitudes.

    `identify_backbone` as a `MethodResult`; where only the drive voltage is known, `fit_jointly`
    with the force gain and the instrument phase as unknowns. Arguments: `data` and `modes` as for
    these functions. Returns a `MethodResult` between the smallest and the largest measured
    amplitude; 1σ from the stated errors or from the scatter about the curve.
    Raises `ValueError` as these functions do.
    Reference: Kwarta & Allen, section 2.2.
    """
    if np.isfinite(np.asarray(data.force)).any():
        identification = identify_backbone(data, modes)
        backbone, notes = identification.backbone, identification.notes
    else:
        joint = fit_jointly(data, modes, free=("instrument_phase",))
        backbone, notes = as_backbone(joint), joint.notes
    curve = backbone.sampled(_SAMPLES)
    points = points_of_curves(
        curve.velocity,
        curve.natural_frequency,
        curve.natural_frequency_std,
        curve.damping_ratio,
        curve.damping_ratio_std,
    )
    return method_result("snrm", points, data.n_states, notes)


METHODS: dict[str, Method] = {
    "snrm": snrm,
    "concerto": concerto,
    "arslan_ozguven": arslan_ozguven,
    "rct": rct,
    "harmonic_force_surface": harmonic_force_surface,
    "phase_resonance": phase_resonance,
}
"""Methods for tables of steady states, by name."""


class Distance(NamedTuple):
    """Medians over a method's points of their distance from the reference."""

    method: str
    frequency: float  # rad/s
    damping: float  # relative
    n_points: int


class Comparison(NamedTuple):
    """The methods' results, and why the others could not run."""

    results: tuple[MethodResult, ...]
    stopped: dict[str, str]  # method: why
    data: SteadyStates | None = None  # of tables, stepped sines and slow sweeps
    records: tuple[Fact, ...] = ()  # kind of each time record, and the rule that decided
    decays: tuple[Fact, ...] = ()  # interfering modes in free decays

    @property
    def reference(self) -> MethodResult | None:
        """The result that distances refer to: the inverse SNRM, else the first with points."""
        results = [result for result in self.results if result.has_result.any()]
        return next((r for r in results if r.method == "snrm"), results[0] if results else None)

    def distances(self) -> tuple[Distance, ...]:
        """Distance of each method from the reference, within the reference's amplitude range."""
        reference = self.reference
        if reference is None:
            return ()
        at = np.asarray(reference.velocity)[reference.has_result]
        distances = []
        for result in self.results:
            velocity = np.asarray(result.velocity)
            kept = result.has_result & (velocity >= at.min()) & (velocity <= at.max())
            if not kept.any():
                continue
            omega, ratio = (
                np.interp(velocity[kept], at, np.asarray(curve)[reference.has_result])
                for curve in (reference.natural_frequency, reference.damping_ratio)
            )
            off = np.abs(np.asarray(result.natural_frequency)[kept] - omega)
            damping = np.abs(np.asarray(result.damping_ratio)[kept] / ratio - 1)
            medians = float(np.median(off)), float(np.median(damping))
            distances.append(Distance(result.method, *medians, int(kept.sum())))
        return tuple(distances)


@on_numbers("Differentiate `sj.identify.identify_points`.")
def compare_methods(
    data: SteadyStates | Sequence[SteadyStates | TimeRecording],
    modes: LinearModes,
    methods: Sequence[str] | None = None,
) -> Comparison:
    """Run several methods on the same tests.

    Arguments: `data` are steady states, or a list of steady states and time records of one
    structure. Records are classified (`recorded_test` states the rules): stepped sines and slow
    sweeps become steady states, free decays and broadband records go to the time-domain methods.
    Levels of different tests are kept apart. `methods` are names in `METHODS` and
    `RECORD_METHODS`; by default all that accept data of these kinds. A method that the data do
    not allow is in `stopped` with the reason; the others still run.
    Raises `ValueError` for an unknown method, and where no method could run or gave a point.
    Not differentiable: differentiate `snrmjax.identify.identify_points`.
    """
    known = (*METHODS, *RECORD_METHODS)
    names = list(known) if methods is None else list(methods)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(
            f"`methods` must be among {', '.join(known)}, but has {', '.join(unknown)}."
        )
    sorting = _sorted([data] if isinstance(data, SteadyStates) else list(data), modes)
    results: list[MethodResult] = []
    stopped: dict[str, str] = {}
    absent: dict[str, str] = {}  # methods without data of their kind
    for name in names:
        _log.info("runs the method %s", name)
        if name in RECORD_METHODS:
            run = run_record_method(name, sorting.tests, modes)
            if run.result is not None:
                results.append(run.result)
            else:
                (stopped if run.had_data else absent)[name] = run.reason
        elif sorting.states is None:
            if sorting.without_states:
                stopped[name] = sorting.without_states[0]
            else:
                absent[name] = "steady states are needed, and the data have none."
        else:
            try:
                results.append(METHODS[name](sorting.states, modes))
            except (InputError, np.linalg.LinAlgError) as error:
                stopped[name] = str(error)
    if sorting.unknown:  # methods without other data report why a record was rejected
        absent = dict.fromkeys(absent, sorting.unknown[-1])
    stopped = {name: f"{name}: {why}" for name, why in (stopped | absent).items()}
    if not results:
        raise InputError(f"no method could run; {next(iter(stopped.values()), 'none was given.')}")
    if not any(result.has_result.any() for result in results):
        why = MethodStatus(int(results[0].status[0])).message
        raise InputError(f"no method gave a point; {results[0].method}: {why}.")
    return Comparison(
        tuple(results), stopped, sorting.states, sorting.facts(), sorting.interfering()
    )


class _Data(NamedTuple):
    """Tables and records by kind."""

    states: SteadyStates | None  # of tables, steps and sweeps
    tests: list[RecordedTest]
    counts: list[Fact | None]  # number of states from each record
    unknown: list[str]  # reasons why records are of no known kind
    without_states: list[str]  # reasons why steps and sweeps give no states

    def facts(self) -> tuple[Fact, ...]:
        """Kind of each record, the rule that decided, and its number of states."""
        taken = (
            Fact("record_sorted", name=t.recording.name, kind=t.kind.value, why=t.why, states=n)
            for t, n in zip(self.tests, self.counts, strict=True)
        )
        left_out = (Fact("data_left_out", why=why) for why in self.unknown + self.without_states)
        return (*taken, *left_out)

    def interfering(self) -> tuple[Fact, ...]:
        """How the mode of each free decay was isolated, and its interfering modes."""
        return tuple(
            Fact("note_of_decay", name=test.recording.name, note=note)
            for test in self.tests
            for decay in test.decays
            for note in decay.notes
        )


def _sorted(parts: Sequence[SteadyStates | TimeRecording], modes: LinearModes) -> _Data:
    states = [part for part in parts if isinstance(part, SteadyStates)]
    sorting = _Data(None, [], [], [], [])
    for part in parts:
        if isinstance(part, SteadyStates):
            continue
        try:
            sorting.tests.append(recorded_test(part, modes))
        except InputError as error:
            sorting.unknown.append(str(error))
            continue
        sorting.counts.append(None)
        if sorting.tests[-1].kind is RecordKind.FREE_DECAY:
            sorting.tests[-1] = with_decays(sorting.tests[-1], modes)
        if sorting.tests[-1].kind in (RecordKind.STEPPED_SINE, RecordKind.SLOW_SWEEP):
            try:
                of_record, sorting.counts[-1] = states_of(sorting.tests[-1])
                states.append(of_record)
            except InputError as error:
                sorting.without_states.append(str(error))
    if not states:
        return sorting
    joined = states[0] if len(states) == 1 else join_steady_states(with_levels_apart(states))
    return sorting._replace(states=joined)
