"""What linear modes are found from: responses, steady states or records, by the files' content."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.response_data import joined_responses
from snrmjax.identify.scaling.scale import (
    AddedMassTest,
    DrivePoint,
    KnownShape,
    Scale,
    SensorMasses,
)
from snrmjax.io.exchange.own_tables import is_own_file
from snrmjax.io.files import file_name
from snrmjax.io.laboratory.reading import read_laboratory_file
from snrmjax.io.tables import read_steady_states
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, join_steady_states


def read_modal_sources(
    paths: Sequence[Path],
) -> FrequencyResponses | SteadyStates | tuple[TimeRecording, ...]:
    """One test from its files: joined frequency responses, steady states, or records of decays.

    Raises `ValueError` that names the file: of mixed kinds, with nothing of these in it, or as its
    reader says.
    """
    found = [_read(path) for path in paths]
    kinds = {type(one) for one in found}
    if len(kinds) > 1:
        listed = ", ".join(
            f"{path.name} holds {_WORDS[type(one)]}" for path, one in zip(paths, found, strict=True)
        )
        raise ValueError(f"files of one test must be of one kind, but {listed}.")
    if isinstance(found[0], FrequencyResponses):
        return joined_responses([one for one in found if isinstance(one, FrequencyResponses)])
    if isinstance(found[0], SteadyStates):
        states = [one for one in found if isinstance(one, SteadyStates)]
        return states[0] if len(states) == 1 else join_steady_states(states)
    return tuple(record for one in found if isinstance(one, tuple) for record in one)


_WORDS = {
    FrequencyResponses: "frequency responses",
    SteadyStates: "steady states",
    tuple: "records",
}


def _read(path: Path) -> FrequencyResponses | SteadyStates | tuple[TimeRecording, ...]:
    if path.suffix.lower() == ".csv" and is_own_file(path):
        return read_steady_states(path)
    held = read_laboratory_file(path)
    if held.responses:
        return joined_responses(held.responses)
    if held.recordings:
        forces = [c.name for one in held.recordings for c in one.channels if c.quantity == "force"]
        if forces:
            raise ValueError(
                f"{file_name(path)} holds time records with a force ({forces[0]}): modes need "
                "frequency responses of them, or records of a decay without a force."
            )
        return held.recordings
    raise ValueError(
        f"{file_name(path)} holds neither frequency responses nor records nor our table of steady "
        "states: `snrmjax import` says what it holds, and a map what its columns are."
    )


def sensor_values(option: str, words: Sequence[str]) -> dict[str, float]:
    """Numbers by sensor from words such as "tip=0.2".

    Raises `ValueError` for a word that is none, and for a sensor that comes twice.
    """
    found: dict[str, float] = {}
    for word in words:
        name, equals, value = word.rpartition("=")
        try:
            number = float(value)
        except ValueError:
            equals = ""
            number = 0.0
        if not equals or not name:
            raise ValueError(f"{option} must be a sensor and a number as tip=0.2, but is {word!r}.")
        if name in found:
            raise ValueError(f"{option} names the sensor {name} twice.")
        found[name] = number
    return found


def asked_scale(
    drive: DrivePoint,
    *,
    unscaled: bool = False,
    added_mass: float | None = None,
    mass_at: str | None = None,
    with_mass: LinearModalFit | DecayModes | None = None,
    sensor_mass: Mapping[str, float] = {},
    fixture_mass: float | None = None,
    known_shape: Mapping[str, float] = {},
) -> Scale | None:
    """The one way to scale shapes that was asked for; without one, the drive point.

    Raises `ValueError` where two ways were asked for, or an added mass lacks a part.
    """
    ways: dict[str, Scale | None] = {}
    if unscaled:
        ways["unscaled shapes"] = None
    if drive.sensor is not None:
        ways["a drive point"] = drive
    if added_mass is not None or with_mass is not None:
        if added_mass is None or mass_at is None or not isinstance(with_mass, LinearModalFit):
            raise ValueError(
                "an added mass needs its kilograms, the sensor where it is, and frequency "
                "responses of a second test with it."
            )
        ways["an added mass"] = AddedMassTest(with_mass, mass_at, added_mass)
    if sensor_mass or fixture_mass is not None:
        ways["sensor masses"] = SensorMasses(sensor_mass, fixture_mass)
    for name, value in known_shape.items():
        ways["a known shape"] = KnownShape(name, value)
    if len(ways) > 1:
        raise ValueError(f"one scale of the shapes is wanted, but there are {' and '.join(ways)}.")
    return next(iter(ways.values()), drive)
