"""What a command may be asked for: one schema a pipeline, of Python's keywords and of options.

A field says its help once; the commands make their options of it (`snrmjax.cli.options`), and a
pipeline checks that whatever was stated has an effect.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

Options = TypeVar("Options")

FILES = "Files"


class Option(NamedTuple):
    """What a field of options says of itself."""

    help: str
    metavar: str | None = None
    panel: str | None = None  # its topic; without one it stands in the command's short help
    least: float | None = None  # that a number may be
    choices: tuple[str, ...] = ()  # words that it may have, for a shell to complete
    flag: str = ""  # how it is written, where that is not the name
    positive: str = ""  # unit of numbers that must be above zero
    needs: tuple[str, ...] = ()  # options of which one must be stated beside it
    why_needed: str = ""
    alone: tuple[str, ...] = ()  # options of which none may be stated beside it
    why_alone: str = ""


def option(default: Any, help: str, metavar: str | None = None, **further: Any) -> Any:
    """A field of options with its default, the line of its help, and what else `Option` has."""
    return dataclasses.field(default=default, metadata={"option": Option(help, metavar, **further)})


def flag_of(field: dataclasses.Field) -> str:
    """How a field's option is written: `--predict-force`."""
    return field.metadata["option"].flag or f"--{field.name.replace('_', '-')}"


def checked(options: Options) -> Options:
    """The same options, if all that was stated has an effect.

    Raises `ValueError` that names the option: of a number out of its range, of one that belongs to
    another which is not stated, or that has no effect beside another.
    """
    fields = {field.name: field for field in dataclasses.fields(options)}  # type: ignore[arg-type]
    stated = {name for name, one in fields.items() if getattr(options, name) != one.default}
    for name in (known for known in fields if known in stated):
        about: Option = fields[name].metadata["option"]
        flag, value = flag_of(fields[name]), getattr(options, name)
        for number in value if isinstance(value, Sequence) else (value,):
            if about.positive and not 0 < number < float("inf"):
                raise ValueError(
                    f"`{flag}` must be above zero, but is {number:g} {about.positive}."
                )
            if about.least is not None and not number >= about.least:
                raise ValueError(f"`{flag}` must be at least {about.least:g}, but is {number:g}.")
        if about.needs and not stated & set(about.needs):
            raise ValueError(f"`{flag}` {about.why_needed}, or leave it out.")
        beside = [f"`{flag_of(fields[one])}`" for one in about.alone if one in stated]
        if beside:
            raise ValueError(
                f"`{flag}` has no effect beside {' and '.join(beside)}: {about.why_alone}; leave "
                "one of them out."
            )
    return options


_FIT = ("fit", "free", "further")
_LOADS = ("predict_force", "predict_drive")
_PREDICTED, _POINTS, _JOINT = (
    *("Predicted responses", "Curves without --fit"),
    "Joint fit of all states",
)
_FOR_PREDICTIONS: dict[str, Any] = {
    "needs": _LOADS,
    "why_needed": "belongs to predictions: add `--predict-force` (N) or, for data with a drive "
    "voltage, `--predict-drive` (V)",
    "panel": _PREDICTED,
}


# Of the two curves together; a shell completes them without the import of what they are.
FAMILY_NAMES = (
    *("auto", "polynomial", "spline", "smoothing_spline", "power_law", "constant"),
    *("viscous_quadratic", "viscous_coulomb", "viscous_microslip"),
)

COUPLED_MODES = 2
"""Of `IdentifyOptions.modes`: a mode and the one that it exchanges energy with."""


@dataclasses.dataclass(frozen=True)
class IdentifyOptions:
    """What `identify` may be asked for."""

    modes: int | None = option(
        None,
        "2: also identify which mode exchanges energy with the mode of interest (1:1, 1:2, 1:3): "
        "writes the completed model.toml, and predictions are then its responses by harmonic "
        "balance. 1: look at one mode only. Default: look at two where the sensors show a second "
        "one.",
        "COUNT",
        least=1,
        panel="Coupled modes",
        alone=("predict_drive", "predict_at"),
        why_alone="responses of coupled modes are those to forces in N where the test had them",
    )

    predict_force: tuple[float, ...] = option(
        (),
        "Predict resonance and response under this force in N; give it again for more.",
        "N",
        positive="N",
    )
    predict_drive: tuple[float, ...] = option(
        (),
        "The same under this drive voltage in V, for data with drive_v.",
        "V",
        positive="V",
        panel=_PREDICTED,
    )
    predict_at: str | None = option(
        None,
        "Sensor or point at which the forces of the predictions act. Default: as in the test.",
        "POINT",
        panel=_PREDICTED,
        needs=("predict_force",),
        why_needed="belongs to predictions under a force: add `--predict-force` (N)",
        alone=("predict_drive",),
        why_alone="a drive voltage is that of the test's shaker, where it was",
    )
    extrapolate: float | None = option(
        None,
        "Predict up to this multiple of the largest measured amplitude; 1 ends where the data end. "
        "Default: 1.5.",
        "RATIO",
        least=1.0,
        **_FOR_PREDICTIONS,
    )
    day_std: str | None = option(
        None,
        "Predict for another day's test, which differs from this one by so much: relative 1σ of "
        "natural frequency, damping and gain, as 0.001,0.05,0.02.",
        "FREQUENCY,DAMPING,GAIN",
        **_FOR_PREDICTIONS,
    )
    self_excited: bool = option(
        False,
        "Let extrapolated damping be negative, as no passive structure's is.",
        **_FOR_PREDICTIONS,
    )
    amplitude: Literal["displacement", "velocity"] = option(
        "displacement",
        "Amplitude of which natural frequency and damping are functions: displacement (right for a "
        "nonlinear stiffness) or velocity.",
        panel=_POINTS,
        alone=_FIT,
        why_alone="a joint fit names the amplitude with the family, as `--fit "
        "polynomial:2@velocity`",
    )
    measure: Literal["fundamental", "peak"] = option(
        "fundamental",
        "Take the amplitude of the fundamental, or the peak of the motion with its measured "
        "harmonics.",
        panel=_POINTS,
        alone=_FIT,
        why_alone="a joint fit takes the fundamental",
    )
    knots: int | None = option(
        None,
        "Knots of each curve at most. Default: up to 42; curves bend as much as the data ask for.",
        least=2,
        panel=_POINTS,
        alone=_FIT,
        why_alone="a joint fit has the size with the family, as `--fit spline:5`",
    )
    fit: str | None = option(
        None,
        "Fit all states jointly: auto (curves as smooth as the data ask for), or families of "
        "backbone and damping, as polynomial:2,constant.",
        "FAMILIES",
        choices=FAMILY_NAMES,
    )
    free: tuple[str, ...] = option(
        (),
        "Errors of the instruments to be found with the curves: force_gain, force_offset, "
        "instrument_phase; several with commas.",
        "NAMES",
        choices=("force_gain", "force_offset", "instrument_phase"),
    )
    robust: bool = option(
        False,
        "Give outlying states less weight.",
        panel=_JOINT,
        needs=_FIT,
        why_needed="belongs to a joint fit: add `--fit auto`",
    )
    further: int | None = option(
        None,
        "Advise this many further measurements, those that narrow the bands most.",
        "COUNT",
        least=1,
        flag="--next",
    )

    @property
    def is_joint(self) -> bool:
        """Whether a joint fit of all states is asked for."""
        return self.fit is not None or bool(self.free) or self.further is not None


_AFTER = "After a first diagnosis"


@dataclasses.dataclass(frozen=True)
class DiagnoseOptions:
    """What `diagnose` may be asked for, beside its data and model."""

    responses: bool | None = option(
        None,
        "Simulate the responses of the model as given and as completed, for comparison with the "
        "data. Default: for a single file.",
        panel="Drawing",
    )
    where: str = option(
        "",
        "Points and pairs at which the missing force may act, as tip,mid,tip-mid. Default: all "
        "points and neighbouring pairs, if there are several sensors and few points.",
        "PLACES",
    )
    plan: Path | None = option(
        None,
        "Write the measurement that would decide an open answer: a CSV of steady states to be "
        "filled in.",
        "FILE",
    )
    add: tuple[Path, ...] = option(
        (),
        "Further steady states of the same structure, such as a plan that was filled in: one "
        "diagnosis of all states (repeatable).",
        "FILE",
        panel=_AFTER,
    )
    former: Path | None = option(
        None,
        "diagnosis.json of the states without those of `--add`: fits begin at its answers too, and "
        "the notes say what the further states changed.",
        "FILE",
        flag="--continue",
        panel=_AFTER,
        needs=("add",),
        why_needed="needs further states: name their file with `--add`",
    )


_ANSWERS = "Answers to its questions"


@dataclasses.dataclass(frozen=True)
class WholeTestOptions:
    """What `test` may be asked for."""

    model: Path | None = option(
        None,
        "Linear model, in place of the folder's or of frequency responses.",
        "MODEL",
        panel=FILES,
    )
    drive_point: str | None = option(
        *(None, "Sensor at the force, by which mode shapes are scaled.", "NAME"), panel=_ANSWERS
    )
    map_file: Path | None = option(
        None,
        "Map of an import (map.toml) that says what columns and channels are, in place of the "
        "folder's.",
        "TOML",
        flag="--map",
        panel=FILES,
    )
    rate: float | None = option(
        None,
        "Sampling rate of the records in Hz, where files state it with few digits.",
        "HZ",
        positive="Hz",
        panel=_ANSWERS,
    )
    base: Literal["absolute", "relative"] | None = option(
        None,
        "What the sensors record of a structure whose base moves: their own motion (absolute) or "
        "that relative to the base. A model.toml says it itself.",
        "KIND",
        panel=_ANSWERS,
        alone=("drive_point", "model"),
        why_alone="a base has no drive point, and a model says itself what its sensors record",
    )
    go_on: bool = option(False, "Go on in spite of errors that the check finds.", panel=_ANSWERS)
    diagnose: bool = option(True, "Look for what the model lacks, too (a minute or more).")


@dataclasses.dataclass(frozen=True)
class ReduceOptions:
    """What `rom` may be asked for."""

    tables: Path | None = option(
        None,
        "Folder with cases.csv and modes.toml: load cases that another code has run.",
        "DIR",
        panel=FILES,
    )
    calculix: Path | None = option(
        None,
        "CalculiX deck of the structure, with its mesh, material and supports. Its load cases are "
        "kept in a folder beside it (deck.jobs for deck.inp), for later runs.",
        "DECK",
        panel=FILES,
    )
    modes: str | None = option(
        None,
        "Numbers of the modes to keep, with --calculix.",
        "1,3",
        needs=("calculix",),
        why_needed="goes with --calculix: other sources state their modes",
    )
    no_study: bool = option(False, "Leave out the study over the size of the loads.")


_ONE_SCALE = "Scale of the shapes"


@dataclasses.dataclass(frozen=True)
class ModesOptions:
    """What `modes` may be asked for."""

    reference: str | None = option(
        *(None, "Reference channel where there are several.", "NAME"), panel="Fit"
    )
    level: int | None = option(None, "Level of steady states (default: the lowest).", panel="Fit")
    from_hz: float | None = option(None, "Lower end of the band in Hz.", "HZ")
    to_hz: float | None = option(
        None, "Upper end of the band in Hz; decays are thinned to it.", "HZ"
    )
    conjugated: bool = option(
        False, "Responses are those of e^(-iΩt): take their conjugates.", panel="Fit"
    )
    rate: float | None = option(
        *(None, "Sampling rate in Hz of records whose file has few digits.", "HZ"), panel="Fit"
    )
    poles: str | None = option(
        None, "Natural frequencies in Hz by hand, as 79.0,427.5.", "HZ,…", panel="Fit"
    )
    order: int | None = option(None, "Take the poles of one model order.", panel="Fit")
    highest_order: int | None = option(None, "Highest model order.", panel="Fit")
    residual_terms: str = option(
        "auto",
        "Residual terms of modes outside the band: auto, both, lower, upper, none.",
        flag="--residuals",
        panel="Fit",
        choices=("auto", "both", "lower", "upper", "none"),
    )
    window: str | None = option(
        None,
        "hann: model the leakage of averages of random excitation.",
        panel="Fit",
        choices=("hann",),
    )
    instrument_phase: bool | None = option(
        None, "Free a phase of the instruments (default: over a voltage only).", panel="Fit"
    )
    base: str | None = option(
        None,
        "The reference is the motion of a base, the responses are: absolute, relative.",
        "KIND",
        choices=("absolute", "relative"),
    )
    drive_point: str | None = option(
        None, "Sensor at the force (default: by point and axis).", "NAME"
    )
    turned: bool = option(
        False,
        "The drive point's sensor is against the force.",
        panel=_ONE_SCALE,
        alone=("unscaled",),
        why_alone="unscaled shapes have no drive point",
    )
    second_mass: float | None = option(
        None, "Added mass in kg of a second test.", flag="--added-mass", panel=_ONE_SCALE
    )
    mass_at: str | None = option(
        None,
        "Sensor at the added mass.",
        "NAME",
        panel=_ONE_SCALE,
        needs=("second_mass",),
        why_needed="belongs to an added mass: add `--added-mass` (kg)",
    )
    with_mass: tuple[Path, ...] = option(
        (), "Test with the added mass (repeatable).", "FRF", panel=_ONE_SCALE
    )
    sensor_mass: tuple[str, ...] = option(
        (),
        "Mass that a sensor stands for, as tip=0.2 (repeatable); with --base, or with "
        "--fixture-mass.",
        "NAME=KG",
        panel=_ONE_SCALE,
    )
    fixture_mass: float | None = option(
        None, "Mass in kg of a free fixture that is forced.", panel=_ONE_SCALE
    )
    known_shape: str | None = option(
        None,
        "Mass-normalised shape at a sensor, as midspan=11.84.",
        "NAME=VALUE",
        panel=_ONE_SCALE,
    )
    unscaled: bool = option(False, "Relative shapes: frequency and damping only.")
    newtons_per_volt: float | None = option(
        None, "Calibration of a drive voltage.", panel=_ONE_SCALE
    )
    newtons_per_volt_std: float = option(
        0.0,
        "1σ of that calibration.",
        panel=_ONE_SCALE,
        needs=("newtons_per_volt",),
        why_needed="belongs to a calibration: add `--newtons-per-volt`",
    )
    calibration_std: float = option(0.0, "Relative 1σ of response over force.", panel=_ONE_SCALE)
    free: bool = option(False, "Structure free as a rigid body: write that mode.", panel=_ONE_SCALE)
    mass: float | None = option(
        None, "Its mass in kg, if weighed (implies --free).", panel=_ONE_SCALE
    )
