"""A whole test: from a laboratory's folder to linear modes, check, backbone and diagnosis."""

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.doctor.check import check_test
from snrmjax.doctor.column_misreadings import caveat
from snrmjax.doctor.findings import Checkup
from snrmjax.identify.modal.modes_of_tests import find_modes
from snrmjax.identify.modal.response_data import joined_responses
from snrmjax.identify.scaling.scale import DrivePoint, scale_modes
from snrmjax.identify.scaling.scaled_modes import ScaledModes
from snrmjax.io.files import FilePath
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.recordings.channels import channel_number
from snrmjax.measure.recordings.step_counts import StepCounts, joined_counts
from snrmjax.measure.recordings.stepped_sine import SteppedSineStates, stepped_sine_states
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import (
    UNNAMED_SENSOR,
    SteadyStates,
    join_steady_states,
    with_levels_apart,
)
from snrmjax.methods.records.recorded_test import RecordedTest, RecordKind, recorded_test
from snrmjax.model.moving_base import base_motion
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.check import files_of_test, is_certain, with_imports
from snrmjax.pipelines.diagnose import DiagnosedTest, diagnose_test
from snrmjax.pipelines.folder_contents import NamedRecord, TestFiles, read_test_files
from snrmjax.pipelines.identify import IdentifiedTest, Note, identify_test
from snrmjax.pipelines.modes import LinearModesFound, ModalFit
from snrmjax.pipelines.options import WholeTestOptions, checked

_ORDERS = (0, 1, 2, 3, 4, 5)
_MOST = 20_000  # samples of a step that are used, from its end
_FEWEST_ALIKE = 3  # equal states of two files
_ALIKE = 1e-5  # relative difference of frequency and velocity, below test repeatability
_TINY = 1e-300
_MOTIONS = ("velocity", "acceleration", "displacement")


class FoldedRecord(NamedTuple):
    """One steady state, recorded and fitted, folded to one period of the force.

    Phases are relative to the force's fundamental; harmonics e^{+ikΩt}, order 0 first.
    """

    phase: Float[np.ndarray, " sample"]  # rad, from 0 to 2π
    force: Float[np.ndarray, " sample"]  # N (or V)
    response: Float[np.ndarray, " sample"]  # as recorded, in the SI unit of its quantity
    force_harmonics: Complex[np.ndarray, " harmonic"]
    response_harmonics: Complex[np.ndarray, " harmonic"]
    orders: tuple[int, ...]
    quantity: str = "velocity"
    unit: str = "m/s"


def folded_records(
    recording: TimeRecording, steps: SteppedSineStates, force: str, response: str
) -> list[FoldedRecord | None]:
    """Every steady state of a record folded to one period, in the order of the states.

    Arguments: `steps` from `stepped_sine_states` of `recording`; `force` and `response` are
    names of channels. Harmonics 0 to 5 are fitted by least squares to the end of each step; None
    where a period has too few samples for them.
    """
    channel = recording.channels[channel_number(recording.channels, response)]
    folded: list[FoldedRecord | None] = [None] * steps.states.n_states
    for step in np.flatnonzero(np.asarray(steps.state) >= 0):
        omega = float(steps.frequency[step])
        stop = _sample(recording, float(steps.stop[step]))
        start = max(_sample(recording, float(steps.settled_from[step])), stop - _MOST)
        if omega * max(_ORDERS) >= np.pi * recording.sampling_rate:
            continue
        both = recording.values([force, response], start, stop)
        angle = omega * recording.time(start, stop)
        fitted, *_ = np.linalg.lstsq(_basis(angle), both.T, rcond=None)
        n = len(_ORDERS)
        phasors = fitted[:n] - 1j * np.concatenate([np.zeros((1, 2)), fitted[n:]])
        lead = float(np.angle(phasors[1, 0]))
        phasors = phasors * np.exp(-1j * lead * np.array(_ORDERS))[:, None]
        phase = np.mod(angle + lead, 2 * np.pi)
        folded[int(steps.state[step])] = FoldedRecord(
            phase=phase,
            force=both[0],
            response=both[1],
            force_harmonics=phasors[:, 0],
            response_harmonics=phasors[:, 1],
            orders=_ORDERS,
            quantity=channel.quantity,
            unit=channel.si_unit,
        )
    return folded


def _sample(recording: TimeRecording, at: float) -> int:
    number = round((at - recording.start_time) * recording.sampling_rate)
    return min(max(number, 0), recording.n_samples)


def _basis(angle: np.ndarray) -> np.ndarray:
    cosines = [np.cos(order * angle) for order in _ORDERS]
    return np.stack([*cosines, *(np.sin(order * angle) for order in _ORDERS[1:])], axis=1)


class SteppedRecord(NamedTuple):
    """A record of a stepped sine: its steady states, and each folded to one period."""

    file: str
    steps: SteppedSineStates
    folded: tuple[FoldedRecord | None, ...]


class WholeTest(NamedTuple):
    """Results from the files of one test."""

    name: str
    files: TestFiles
    model: Structure
    modes: LinearModesFound | None  # None where the folder had a model
    records: tuple[tuple[str, RecordedTest], ...]  # by file
    stepped: tuple[SteppedRecord, ...]
    counts: StepCounts | None  # of all steps; None where not all states are from steps
    data: SteadyStates  # of all files
    checkup: Checkup
    identified: IdentifiedTest
    diagnosed: DiagnosedTest | None
    left_out: tuple[Note, ...]  # reasons for omitting the diagnosis
    notes: tuple[Note, ...]

    @property
    def folded(self) -> list[FoldedRecord | None]:
        """The folded record of every state; None for states of tables."""
        of_steps = [each for record in self.stepped for each in record.folded]
        return [None] * (self.data.n_states - len(of_steps)) + of_steps


def run_whole_test(
    folder: FilePath,
    options: WholeTestOptions | None = None,
    *,
    progress: Callable[[str, float], None] = lambda stage, seconds: None,
    **settings: Any,
) -> WholeTest:
    """Linear modes, steady states, check, backbone and diagnosis of the files in a folder.

    Arguments: `options`, or its fields by keyword; `progress` is called with each stage and its
    seconds when it ends.
    Raises `ValueError`, as a question, where the input is ambiguous: which sensor is at the force,
    or whether to continue in spite of errors; and as its stages do.
    """
    options = checked(dataclasses.replace(options or WholeTestOptions(), **settings))
    folder = Path(folder)
    stage, name = _Stages(progress), folder.resolve().name
    files = read_test_files(folder, options.model, options.rate or 0.0, options.map_file)
    read = files_of_test(folder, files, options.map_file)
    stage.ends("files")
    model, modes = files.model, None
    if model is not None and options.base is not None:
        raise InputError(
            f"`--base` has no effect with {files.model_file}, whose [base] states what the sensors "
            "record: leave it out."
        )
    if model is None:
        modes = _linear_modes(files, options)
        model = modes.structure
    stage.ends("linear modes")
    records = tuple((named.file, _sorted(named, model)) for named in files.records)
    stepped = tuple(
        _steps(named, test)
        for named, (_, test) in zip(files.records, records, strict=True)
        if test.kind is RecordKind.STEPPED_SINE
    )
    tables = [table.of_model(model) for table in files.states]
    parts = with_levels_apart([*tables, *(each.steps.states for each in stepped)])
    if not parts:
        raise InputError(
            f"{name} holds no steady states and no record of a stepped sine: it determines only "
            "linear modes, as written by `snrmjax modes`."
        )
    _refuse_doubled([*(t.file for t in files.states), *(each.file for each in stepped)], parts)
    data = join_steady_states(parts)
    stage.ends(f"{data.n_states} steady states")
    checkup = check_test(parts, model, [named.record for named in files.records])
    checkup = with_imports(checkup, read)
    if not options.go_on:
        _stop_at_errors(checkup)
    stage.ends("check")
    drive_only = not np.isfinite(np.asarray(data.force)).any()
    free = ("instrument_phase",) if drive_only else ()
    identified = identify_test(data, model, fit="auto", free=free)
    stage.ends("backbone and damping")
    diagnosed = None
    left_out = not_diagnosed(data, model) if options.diagnose else ()
    if options.diagnose and not left_out:
        diagnosed = diagnose_test(data, model)
        stage.ends("diagnosis")
    notes = (
        *left_out,
        *files.notes,
        *_taken_sensors(files, model),
        *(_note_on_steps(each) for each in stepped),
    )
    counts = _used_steps(files, stepped)
    return WholeTest(
        name,
        files,
        model,
        modes,
        records,
        stepped,
        counts,
        data,
        checkup,
        identified,
        diagnosed,
        left_out,
        notes,
    )


class _Stages:
    """Report each stage with its seconds."""

    def __init__(self, progress: Callable[[str, float], None]) -> None:
        self.progress, self.began = progress, time.perf_counter()

    def ends(self, name: str) -> None:
        """Report a stage that has ended."""
        now = time.perf_counter()
        self.progress(name, now - self.began)
        self.began = now


def not_diagnosed(data: SteadyStates, model: Structure) -> tuple[Note, ...]:
    """Reasons against a diagnosis: phases, units or scales inconsistent with the model's mode.

    The search would fit them by ever larger effects, whose harmonic balance takes many minutes. A
    mode that is only far from the linear one is diagnosed, as effects may cause it.
    """
    caveats = (*wrong_phases(data, model), *caveat(data, model))
    return (Fact("diagnosis_left_out", why=str(caveats[0])),) if caveats else ()


def _note_on_steps(record: SteppedRecord) -> Note:
    return Fact("note_of_file", file=record.file, note=record.steps.counts.fact)


def _taken_sensors(files: TestFiles, model: Structure) -> tuple[Note, ...]:
    """Note on files without sensor name, which are assigned to the model's only sensor."""
    names = tuple(table.file for table in files.states if table.names_no_sensor)
    if not names or model.modes.sensors == UNNAMED_SENSOR:
        return ()
    return (Fact("sensor_not_named", files=names, sensor=model.modes.sensors[0]),)


def _linear_modes(files: TestFiles, options: WholeTestOptions) -> LinearModesFound:
    if files.responses:
        source: object = joined_responses([named.responses for named in files.responses])
    elif files.states:
        source = join_steady_states(with_levels_apart([table.states for table in files.states]))
    else:
        raise InputError(
            "what are the linear modes? The folder has only time records: put a model.toml or "
            "frequency responses into it."
        )
    fitted, notes = find_modes(source, base=options.base)  # type: ignore[arg-type]
    if options.base is not None:
        # Base excitation determines the product of shape and participation, which suffices.
        scaled = scale_modes(fitted, None)
        scaled = dataclasses.replace(scaled, base=base_motion(options.base))
    else:
        scaled = _scaled(fitted, DrivePoint(options.drive_point))
    return LinearModesFound("model", fitted, scaled, _nearest_mode(scaled, files), notes)


def _scaled(fitted: ModalFit, by: DrivePoint) -> ScaledModes:
    try:
        return scale_modes(fitted, by)
    except InputError as error:
        if by.sensor is None:
            way = "Answer by `--drive-point SENSOR`, or write"
        else:
            way = f"Name another sensor than {by.sensor}, or write"
        raise InputError(
            f"how are the mode shapes scaled? {error} {way} the model by `snrmjax "
            "modes`, which has further ways, into this folder."
        ) from error


def _nearest_mode(scaled: ScaledModes, files: TestFiles) -> int:
    """The mode nearest to the steady states; the first where there are none."""
    if not files.states:
        return 0
    frequency = np.concatenate([np.asarray(table.states.frequency) for table in files.states])
    return int(np.argmin(np.abs(np.asarray(scaled.natural_frequency) - np.median(frequency))))


def _sorted(named: NamedRecord, model: Structure) -> RecordedTest:
    try:
        return recorded_test(dataclasses.replace(named.record, name=named.file), model.modes)
    except InputError as error:
        if any(channel.quantity in _MOTIONS for channel in named.record.channels):
            raise
        raise InputError(
            f"{error} `snrmjax import {named.file}` lists its content and how to import it; "
            "put the map.toml that the import writes into the folder."
        ) from error


def _refuse_doubled(names: Sequence[str], parts: Sequence[SteadyStates]) -> None:
    """Raise `ValueError` where two files hold the same states, closer than any repetition."""
    for (a, one), (b, two) in itertools.combinations(zip(names, parts, strict=True), 2):
        first, second = (
            np.log([part.frequency, np.sum(np.abs(part.velocity), axis=1) + _TINY])
            for part in (one, two)
        )
        apart = np.max(np.abs(first[:, :, None] - second[:, None, :]), axis=0)
        same = int(np.sum(apart.min(axis=0) < _ALIKE))
        if same >= max(_FEWEST_ALIKE, min(one.n_states, two.n_states) / 2):
            raise InputError(
                f"which of {a} and {b} is the test? Both hold the same {same} steady states, which "
                "would count twice: move one of them out of the folder."
            )


def _steps(named: NamedRecord, test: RecordedTest) -> SteppedRecord:
    """Steady states of a stepped sine, by its channels."""
    channels = test.channels
    force = channels.force or channels.drive
    if force is None:
        raise InputError(f"{named.file} is a stepped sine, but has no channel of force or drive.")
    steps = stepped_sine_states(
        named.record,
        force,
        channels.motions,
        sensors=channels.sensors,
        drive=channels.drive if channels.force else None,
    )
    folded = folded_records(named.record, steps, force, channels.reference)
    return SteppedRecord(named.file, steps, tuple(folded))


def _used_steps(files: TestFiles, stepped: Sequence[SteppedRecord]) -> StepCounts | None:
    """Step counts of the records, or of the imported tables; None if incomplete."""
    if stepped:
        return None if files.states else joined_counts([each.steps.counts for each in stepped])
    imported = files.steps_at_import
    used = sum(table.states.n_states for table in files.states)
    return imported if imported is not None and imported.used == used else None


def _stop_at_errors(checkup: Checkup) -> None:
    errors = [finding for finding in checkup.findings if finding.severity == "error"]
    if not errors:
        return
    first, *others = errors
    more = "".join(
        f" {'In addition,' if is_certain(first) and is_certain(other) else 'Or'} {other.evidence} "
        f"{other.advice}"
        for other in others
    )
    raise InputError(
        f"is this intended? {first.name} in {first.where}: {first.evidence} To correct "
        f"it: {first.advice}{more} To continue nevertheless: `--go-on`."
    )
