"""Linear modes from laboratory files: sources by content, modal fit, scale of the shapes."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.linear_fit import GrowingModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.modes_of_tests import find_modes
from snrmjax.identify.modal.response_data import joined_responses
from snrmjax.identify.scaling.scale import (
    AddedMassTest,
    Calibration,
    DrivePoint,
    Free,
    KnownShape,
    Scale,
    SensorMasses,
    scale_modes,
)
from snrmjax.identify.scaling.scaled_modes import ScaledModes
from snrmjax.io.exchange.own_tables import is_own_file
from snrmjax.io.exchange.record_import import ask_for_rate, at_stated_rate
from snrmjax.io.files import FilePath, file_name
from snrmjax.io.laboratory.reading import read_laboratory_file
from snrmjax.io.tables import read_steady_states
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states
from snrmjax.model.moving_base import SensorMotion, base_motion
from snrmjax.model.structures import Structure, structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.options import ModesOptions, checked, flag_of

ModalFit = LinearModalFit | DecayModes
ModalSources = FrequencyResponses | SteadyStates | tuple[TimeRecording, ...]


class LinearModesFound(NamedTuple):
    """Linear modes, the scale of their shapes, and their modal fit."""

    name: str
    fitted: ModalFit
    scaled: ScaledModes
    interest: int  # mode of interest, from zero
    notes: tuple[Fact | str, ...]

    @property
    def structure(self) -> Structure:
        """The modes as the linear model of a test."""
        return structure(self.scaled.linear_modes(self.interest), name=self.name)


def find_linear_modes(
    sources: ModalSources,
    options: ModesOptions | None = None,
    *,
    with_mass: ModalSources | None = None,
    interest: int = 0,
    name: str = "model",
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> LinearModesFound:
    """Linear modes with errors, their shapes mass-normalised as requested.

    Arguments: `sources` from `read_modal_sources`; `options`, or its fields by keyword;
    `with_mass` are the sources of a second test with the added mass; `interest` counts from zero;
    `progress` is called with the number of fitted parts of a decay and their total.
    Raises `ValueError` as `find_modes` and `scale_modes` do, and for two ways to scale.
    """
    options = checked(dataclasses.replace(options or ModesOptions(), **settings))
    _refuse_unused(options, sources)
    sources = _as_stated(sources, options)
    low, high = options.from_hz, options.to_hz
    fit: dict[str, Any] = {
        name: getattr(options, name)
        for name in (
            *("reference", "level", "order", "highest_order", "residual_terms", "window"),
            *("instrument_phase", "base"),
        )
    }
    fit |= {
        "from_frequency": None if low is None else low * HERTZ,
        "to_frequency": None if high is None else high * HERTZ,
        "poles": _poles(options.poles),
    }
    try:
        fitted, notes = find_modes(sources, **fit, progress=progress)
    except GrowingModes as error:
        way = "leave `--conjugated` out" if options.conjugated else "state `--conjugated`"
        raise InputError(f"{str(error).rstrip('.')}: {way}.") from error
    second = None if with_mass is None else find_modes(_as_stated(with_mass, options), **fit)[0]
    scaled = scale_modes(
        fitted,
        _requested_scale(options, second),
        calibration=Calibration(
            options.newtons_per_volt, options.newtons_per_volt_std, options.calibration_std
        ),
        free=Free(options.mass) if options.free or options.mass is not None else None,
    )
    base = sources.base if isinstance(sources, SteadyStates) else None
    if options.base is not None:
        base = base_motion(cast(SensorMotion, options.base))
    scaled = dataclasses.replace(scaled, base=base)
    return LinearModesFound(name, fitted, scaled, interest, (*notes, *scaled.notes))


def _as_stated(sources: ModalSources, options: ModesOptions) -> ModalSources:
    """Sources with the stated phasor convention and sampling rate.

    Raises `ValueError` for records whose few digits do not determine their rate.
    """
    if isinstance(sources, FrequencyResponses):
        for channel in sources.responses:
            if channel.quantity == "unknown":
                raise InputError(
                    f"the file does not state the quantity of {channel.name}: import it with the "
                    f"force 1 (`snrmjax import FILE --response {channel.name}:QUANTITY:UNIT "
                    "--force-amplitude 1 --out DIR`), and give `modes` the measured.csv."
                )
        values = sources.values.conj() if options.conjugated else sources.values
        return dataclasses.replace(sources, values=values)
    if isinstance(sources, SteadyStates):
        velocity = sources.velocity.conj() if options.conjugated else sources.velocity
        return dataclasses.replace(sources, velocity=velocity)
    rate = options.rate or 0.0
    for record in sources:
        ask_for_rate(record.notes, rate, record.name)
    return tuple(at_stated_rate(record, rate, record.name) for record in sources)


def _refuse_unused(options: ModesOptions, sources: ModalSources) -> None:
    """Raise `ValueError` for an option without effect on modes from these sources."""
    kind = type(sources) if isinstance(sources, FrequencyResponses | SteadyStates) else tuple
    for field in dataclasses.fields(options):
        stated = getattr(options, field.name) != field.default
        if stated and field.name in _UNUSED[kind]:
            raise InputError(
                f"`{flag_of(field)}` has no effect on modes from {_WORDS[kind]}: leave it out."
            )


def read_modal_sources(
    files: Sequence[FilePath],
) -> FrequencyResponses | SteadyStates | tuple[TimeRecording, ...]:
    """One test from its files: joined frequency responses, steady states, or records of decays.

    Raises `ValueError`, with the file's name, for mixed kinds, for a file without such data, and
    as its reader does.
    """
    paths = [Path(file) for file in files]
    sources = [_read(path) for path in paths]
    kinds = {type(one) for one in sources}
    if len(kinds) > 1:
        listed = ", ".join(
            f"{path.name} holds {_WORDS[type(one)]}"
            for path, one in zip(paths, sources, strict=True)
        )
        raise InputError(f"files of one test must be of one kind, but {listed}.")
    if isinstance(sources[0], FrequencyResponses):
        return joined_responses([one for one in sources if isinstance(one, FrequencyResponses)])
    if isinstance(sources[0], SteadyStates):
        states = [one for one in sources if isinstance(one, SteadyStates)]
        return states[0] if len(states) == 1 else join_steady_states(states)
    return tuple(record for one in sources if isinstance(one, tuple) for record in one)


_UNUSED: dict[type, tuple[str, ...]] = {
    FrequencyResponses: ("level", "rate"),
    SteadyStates: ("window", "rate"),
    tuple: (
        *("level", "reference", "order", "from_hz", "residual_terms", "window"),
        *("instrument_phase", "base", "conjugated"),
    ),
}
_WORDS = {
    FrequencyResponses: "frequency responses",
    SteadyStates: "steady states",
    tuple: "records",
}


def _read(path: Path) -> FrequencyResponses | SteadyStates | tuple[TimeRecording, ...]:
    if path.suffix.lower() == ".csv" and is_own_file(path):
        return read_steady_states(path)
    content = read_laboratory_file(path)
    if content.responses:
        return joined_responses(content.responses)
    if content.recordings:
        forces = [
            c.name
            for recording in content.recordings
            for c in recording.channels
            if c.quantity == "force"
        ]
        if forces:
            raise InputError(
                f"{file_name(path)} holds time records with a force ({forces[0]}): modes need "
                "frequency responses of them, or records of a decay without a force."
            )
        open_rates = [note for note in content.notes if note.kind == "rate_left_open"]
        return tuple(
            dataclasses.replace(record, name=path.name, notes=(*record.notes, *open_rates))
            for record in content.recordings
        )
    raise InputError(
        f"{file_name(path)} holds neither frequency responses nor records nor our table of steady "
        "states: `snrmjax import` lists its content, and a map assigns its columns."
    )


def _sensor_values(option: str, words: Sequence[str]) -> dict[str, float]:
    """Numbers by sensor from words such as "tip=0.2"."""
    values: dict[str, float] = {}
    for word in words:
        name, _, value = word.rpartition("=")
        try:
            number = float(value)
        except ValueError:
            name = ""
        if not name:
            raise InputError(f"{option} must be a sensor and a number as tip=0.2, but is {word!r}.")
        if name in values:
            raise InputError(f"{option} names the sensor {name} twice.")
        values[name] = number
    return values


def _requested_scale(options: ModesOptions, with_mass: ModalFit | None) -> Scale | None:
    """The requested scale of the shapes; by default the drive point."""
    drive = DrivePoint(options.drive_point, options.turned)
    ways: dict[str, Scale | None] = {}
    if options.unscaled:
        ways["unscaled shapes"] = None
    if drive.sensor is not None:
        ways["a drive point"] = drive
    if options.second_mass is not None or with_mass is not None:
        if (
            options.second_mass is None
            or options.mass_at is None
            or not isinstance(with_mass, LinearModalFit)
        ):
            raise InputError(
                "an added mass needs its mass in kg, the sensor at it, and frequency responses of "
                "a second test with it."
            )
        ways["an added mass"] = AddedMassTest(with_mass, options.mass_at, options.second_mass)
    masses = _sensor_values("--sensor-mass", options.sensor_mass)
    if masses or options.fixture_mass is not None:
        ways["sensor masses"] = SensorMasses(masses, options.fixture_mass)
    known = () if options.known_shape is None else (options.known_shape,)
    for name, value in _sensor_values("--known-shape", known).items():
        ways["a known shape"] = KnownShape(name, value)
    if len(ways) > 1:
        raise InputError(f"one scale of the shapes is needed, but there are {' and '.join(ways)}.")
    return next(iter(ways.values()), drive)


def _poles(text: str | None) -> tuple[float, ...] | None:
    """Natural frequencies (rad/s) from "79.0,427.5"."""
    if text is None:
        return None
    try:
        return tuple(float(word) * HERTZ for word in text.split(","))
    except ValueError as error:
        raise InputError(
            f"--poles must be frequencies in Hz with commas between them, but is {text!r}."
        ) from error
