"""Options of the commands: one schema per pipeline, for Python keywords and command-line options.

A field has its help text; the commands build their options from it (`snrmjax.cli.options`), and a
pipeline checks that every stated option has an effect.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from snrmjax.numerics.rules import InputError

Options = TypeVar("Options")

FILES = "Files"


class Option(NamedTuple):
    """Description of a field of options."""

    help: str
    metavar: str | None = None
    panel: str | None = None  # its topic; without one it is in the command's short help
    least: float | None = None  # lower bound of a number
    choices: tuple[str, ...] = ()  # allowed words, for shell completion
    flag: str = ""  # where it differs from the name
    positive: str = ""  # unit of numbers that must be above zero
    needs: tuple[str, ...] = ()  # options of which one must also be stated
    why_needed: str = ""
    alone: tuple[str, ...] = ()  # options that exclude it
    why_alone: str = ""


def option(default: Any, help: str, metavar: str | None = None, **further: Any) -> Any:
    """A field of options with default, help line, and further fields of `Option`."""
    return dataclasses.field(default=default, metadata={"option": Option(help, metavar, **further)})


def flag_of(field: dataclasses.Field) -> str:
    """A field's option on the command line, such as `--predict-force`."""
    return field.metadata["option"].flag or f"--{field.name.replace('_', '-')}"


def checked(options: Options) -> Options:
    """The same options, if every stated one has an effect.

    Raises `ValueError`, with the option's name, for a number out of its range, for an option that
    needs another which is not stated, and for one without effect together with another.
    """
    fields = {field.name: field for field in dataclasses.fields(options)}  # type: ignore[arg-type]
    stated = {name for name, one in fields.items() if getattr(options, name) != one.default}
    for name in (known for known in fields if known in stated):
        about: Option = fields[name].metadata["option"]
        flag, value = flag_of(fields[name]), getattr(options, name)
        for number in value if isinstance(value, Sequence) else (value,):
            if about.positive and not 0 < number < float("inf"):
                raise InputError(
                    f"`{flag}` must be above zero, but is {number:g} {about.positive}."
                )
            if about.least is not None and not number >= about.least:
                raise InputError(f"`{flag}` must be at least {about.least:g}, but is {number:g}.")
        if about.needs and not stated & set(about.needs):
            raise InputError(f"`{flag}` {about.why_needed}, or leave it out.")
        excluding = [f"`{flag_of(fields[one])}`" for one in about.alone if one in stated]
        if excluding:
            raise InputError(
                f"`{flag}` has no effect with {' and '.join(excluding)}: {about.why_alone}; leave "
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


# Families of both curves, listed here so that shell completion imports no curve.
FAMILY_NAMES = (
    *("auto", "polynomial", "spline", "smoothing_spline", "power_law", "constant"),
    *("viscous_quadratic", "viscous_coulomb", "viscous_microslip"),
)

COUPLED_MODES = 2
"""Value of `IdentifyOptions.modes` for the mode of interest and one that it is coupled to."""


@dataclasses.dataclass(frozen=True)
class IdentifyOptions:
    """Options of `identify`."""

    modes: int | None = option(
        None,
        "2: also identify which mode exchanges energy with the mode of interest (1:1, 1:2, 1:3): "
        "writes the completed model.toml, and predictions are then its responses by harmonic "
        "balance. 1: identify one mode only. Default: two where the sensors show a second mode.",
        "COUNT",
        least=1,
        panel="Coupled modes",
        alone=("predict_drive", "predict_at"),
        why_alone="responses of coupled modes are those to forces in N where the test had them",
    )

    predict_force: tuple[float, ...] = option(
        (),
        "Predict resonance and response under this force in N (repeatable).",
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
        why_alone="a drive voltage is that of the test's shaker, at its own point",
    )
    extrapolate: float | None = option(
        None,
        "Predict up to this multiple of the largest measured amplitude; 1: no extrapolation. "
        "Default: 1.5.",
        "RATIO",
        least=1.0,
        **_FOR_PREDICTIONS,
    )
    day_std: str | None = option(
        None,
        "Predict a test on another day: relative 1σ of day-to-day changes of natural frequency, "
        "damping and gain, as 0.001,0.05,0.02.",
        "FREQUENCY,DAMPING,GAIN",
        **_FOR_PREDICTIONS,
    )
    self_excited: bool = option(
        False,
        "Allow negative extrapolated damping, which no passive structure has.",
        **_FOR_PREDICTIONS,
    )
    amplitude: Literal["displacement", "velocity"] = option(
        "displacement",
        "Amplitude over which natural frequency and damping are curves: displacement (right for a "
        "nonlinear stiffness) or velocity.",
        panel=_POINTS,
        alone=_FIT,
        why_alone="a joint fit states the amplitude with the family, as `--fit "
        "polynomial:2@velocity`",
    )
    measure: Literal["fundamental", "peak"] = option(
        "fundamental",
        "Use the amplitude of the fundamental, or the peak of the motion with its measured "
        "harmonics.",
        panel=_POINTS,
        alone=_FIT,
        why_alone="a joint fit uses the fundamental",
    )
    knots: int | None = option(
        None,
        "Most knots of each curve. Default: up to 42; the roughness penalty is fitted to the data.",
        least=2,
        panel=_POINTS,
        alone=_FIT,
        why_alone="a joint fit states the number with the family, as `--fit spline:5`",
    )
    fit: str | None = option(
        None,
        "Fit all states jointly: auto (smoothness from the data), or families of "
        "backbone and damping, as polynomial:2,constant.",
        "FAMILIES",
        choices=FAMILY_NAMES,
    )
    free: tuple[str, ...] = option(
        (),
        "Instrument errors to identify with the curves: force_gain, force_offset, "
        "instrument_phase; several with commas.",
        "NAMES",
        choices=("force_gain", "force_offset", "instrument_phase"),
    )
    robust: bool = option(
        False,
        "Give outlying states less weight, also where noise without outliers is more probable.",
        panel=_JOINT,
        needs=_FIT,
        why_needed="belongs to a joint fit: add `--fit auto`",
    )
    further: int | None = option(
        None,
        "Advise this many further measurements that narrow the bands most.",
        "COUNT",
        least=1,
        flag="--next",
    )

    @property
    def is_joint(self) -> bool:
        """Whether a joint fit of all states is requested."""
        return self.fit is not None or bool(self.free) or self.further is not None


_AFTER = "After a first diagnosis"


@dataclasses.dataclass(frozen=True)
class DiagnoseOptions:
    """Options of `diagnose`, in addition to data and model."""

    responses: bool | None = option(
        None,
        "Simulate the responses of the given and of the completed model, for comparison with the "
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
        "Write the measurement that would resolve an ambiguous answer: a CSV of steady states to "
        "fill in.",
        "FILE",
    )
    add: tuple[Path, ...] = option(
        (),
        "Further steady states of the same structure, such as a filled-in plan: one "
        "diagnosis of all states (repeatable).",
        "FILE",
        panel=_AFTER,
    )
    former: Path | None = option(
        None,
        "diagnosis.json of the states without those of `--add`: fits also start at its answers, "
        "and the notes state what the further states changed.",
        "FILE",
        flag="--continue",
        panel=_AFTER,
        needs=("add",),
        why_needed="needs further states: add their file by `--add`",
    )


_ANSWERS = "Answers to its questions"


@dataclasses.dataclass(frozen=True)
class WholeTestOptions:
    """Options of `test`."""

    model: Path | None = option(
        None,
        "Linear model that replaces the folder's or frequency responses.",
        "MODEL",
        panel=FILES,
    )
    drive_point: str | None = option(
        None, "Sensor at the force, for the scale of the mode shapes.", "NAME", panel=_ANSWERS
    )
    map_file: Path | None = option(
        None,
        "Import map (map.toml) that assigns columns and channels; replaces the folder's.",
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
        "Motion that the sensors record under base excitation: absolute, or relative to the base. "
        "A model.toml states it itself.",
        "KIND",
        panel=_ANSWERS,
        alone=("drive_point", "model"),
        why_alone="a base has no drive point, and a model states what its sensors record",
    )
    go_on: bool = option(False, "Continue in spite of errors found by the check.", panel=_ANSWERS)
    diagnose: bool = option(True, "Also diagnose missing physics (a minute or more).")


@dataclasses.dataclass(frozen=True)
class ReduceOptions:
    """Options of `rom`."""

    tables: Path | None = option(
        None,
        "Folder with cases.csv and modes.toml: load cases solved by another code.",
        "DIR",
        panel=FILES,
    )
    calculix: Path | None = option(
        None,
        "CalculiX deck of the structure, with its mesh, material and supports. Its load cases are "
        "kept in a folder next to it (deck.jobs for deck.inp), for later runs.",
        "DECK",
        panel=FILES,
    )
    modes: str | None = option(
        None,
        "Numbers of the modes to keep, with --calculix.",
        "1,3",
        needs=("calculix",),
        why_needed="needs --calculix: other sources state their modes",
    )
    no_study: bool = option(False, "Leave out the study of the load scale.")


_ONE_SCALE = "Scale of the shapes"


@dataclasses.dataclass(frozen=True)
class ModesOptions:
    """Options of `modes`."""

    reference: str | None = option(
        None, "Reference channel where there are several.", "NAME", panel="Fit"
    )
    level: int | None = option(None, "Level of steady states (default: the lowest).", panel="Fit")
    from_hz: float | None = option(None, "Lower end of the band in Hz.", "HZ")
    to_hz: float | None = option(
        None, "Upper end of the band in Hz; decays are decimated to it.", "HZ"
    )
    conjugated: bool = option(
        False, "Responses have the convention e^(-iΩt): use their conjugates.", panel="Fit"
    )
    rate: float | None = option(
        None, "Sampling rate in Hz of records whose file has few digits.", "HZ", panel="Fit"
    )
    poles: str | None = option(
        None, "Natural frequencies in Hz chosen by hand, as 79.0,427.5.", "HZ,…", panel="Fit"
    )
    order: int | None = option(None, "Use the poles of this model order.", panel="Fit")
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
        None, "Identify an instrument phase (default: only for a drive voltage).", panel="Fit"
    )
    base: str | None = option(
        None,
        "The reference is the base motion; the responses are absolute or relative.",
        "KIND",
        choices=("absolute", "relative"),
    )
    drive_point: str | None = option(
        None, "Sensor at the force (default: by point and axis).", "NAME"
    )
    turned: bool = option(
        False,
        "The drive point's sensor points against the force.",
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
        "Mass represented by a sensor, as tip=0.2 (repeatable); with --base, or with "
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
    free: bool = option(False, "Free structure: write its rigid-body mode.", panel=_ONE_SCALE)
    mass: float | None = option(
        None, "Its mass in kg, if weighed (implies --free).", panel=_ONE_SCALE
    )
