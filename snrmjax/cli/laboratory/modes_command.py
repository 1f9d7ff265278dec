"""The command `modes`: linear modes from frequency responses, low levels and decays."""

from pathlib import Path
from typing import Annotated, Any

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.laboratory.modal_sources import asked_scale, read_modal_sources, sensor_values
from snrmjax.cli.options import FILES, OptionRow, with_options
from snrmjax.io.units import HERTZ


def modes(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Frequency responses (UFF, MATLAB, HDF5, netCDF, CSV), low-level steady states "
            "(CSV as for identify), or records of free decays; several files are one test.",
            metavar="FRF…",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="Model to write (TOML); modes.csv and report.html come beside it.",
            metavar="MODEL",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ],
    interest: Annotated[int, typer.Option(help="Mode of interest, from 1.", min=1)] = 1,
    **options: Any,
) -> None:
    """Find linear modes with their errors and write them as a model.

    Poles of all model orders are fitted to all responses together; shapes are mass-normalised by
    the drive point, an added mass, masses at the sensors or a known shape, or refused.

    Writes the model (TOML), modes.csv and report.html.
    """
    from snrmjax.identify.modal.modes_of_tests import find_modes
    from snrmjax.identify.scaling.scale import Calibration, DrivePoint, Free, scale_modes
    from snrmjax.report.modal.modal_report import modes_sentence, write_linear_modes

    if out.suffix.lower() != ".toml":
        raise ValueError(f"--out must be a model to write (.toml), but is {out.name!r}.")
    if out.is_dir():
        raise ValueError(f"--out {out} is a folder, but a file to write is expected.")
    settings: dict[str, Any] = {row.name: options[row.name] for row in (*_DATA_ROWS, *_FIT_ROWS)}
    low, high = settings.pop("from_hz"), settings.pop("to_hz")
    settings |= {
        "from_frequency": None if low is None else low * HERTZ,
        "to_frequency": None if high is None else high * HERTZ,
        "poles": _poles(options["poles"]),
    }
    shape, with_mass = options["known_shape"], options["with_mass"]
    names = ("newtons_per_volt", "newtons_per_volt_std", "calibration_std")
    calibration = Calibration(*(options[name] for name in names))
    body = Free(options["mass"]) if options["free"] or options["mass"] is not None else None
    with staged(out.parent) as folder:
        found, notes = find_modes(read_modal_sources(data), **settings)
        second = find_modes(read_modal_sources(with_mass), **settings)[0] if with_mass else None
        scale = asked_scale(
            DrivePoint(options["drive_point"], options["turned"]),
            unscaled=options["unscaled"],
            added_mass=options["second_mass"],
            mass_at=options["mass_at"],
            with_mass=second,
            sensor_mass=sensor_values("--sensor-mass", options["sensor_mass"] or ()),
            fixture_mass=options["fixture_mass"],
            known_shape=sensor_values("--known-shape", () if shape is None else (shape,)),
        )
        scaled = scale_modes(found, scale, calibration=calibration, free=body)
        write_linear_modes(
            folder, out.name, scaled, found, interest=interest - 1, further_notes=notes
        )
    for note in (*notes, *scaled.notes):
        warn(note)
    say(modes_sentence(scaled))
    say(f"written to {out}: open {out.parent / 'report.html'}")


def _poles(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    found = []
    for word in text.split(","):
        try:
            found.append(float(word) * HERTZ)
        except ValueError as error:
            raise ValueError(
                f"--poles must be frequencies in Hz with commas between them, but has {word!r}."
            ) from error
    return tuple(found)


_DATA_ROWS = (
    OptionRow("reference", str, "Reference channel where there are several.", "NAME"),
    OptionRow("level", int, "Level of steady states (default: the lowest)."),
)
_FIT_ROWS = (
    OptionRow("from_hz", float, "Lower end of the band."),
    OptionRow("to_hz", float, "Upper end of the band; decays are thinned to it."),
    OptionRow("poles", str, "Natural frequencies in Hz by hand, as 79.0,427.5.", "HZ,…"),
    OptionRow("order", int, "Take the poles of one model order."),
    OptionRow("highest_order", int, "Highest model order."),
    OptionRow(
        *("residual_terms", str),
        "Residual terms of modes outside the band: auto, both, lower, upper, none.",
        default="auto",
        flag="--residuals",
    ),
    OptionRow("window", str, "hann: model the leakage of averages of random excitation."),
    OptionRow(
        *("instrument_phase", bool),
        "Free a phase of the instruments (default: over a voltage only).",
    ),
    OptionRow(
        *("base", str),
        "The reference is the motion of a base, the responses are: absolute, relative.",
        "KIND",
    ),
)
_SCALE_ROWS = (
    OptionRow("drive_point", str, "Sensor at the force (default: by point and axis).", "NAME"),
    OptionRow("turned", bool, "The drive point's sensor is against the force.", None, False),
    OptionRow(
        *("second_mass", float),
        "Added mass in kg of a second test.",
        flag="--added-mass",
    ),
    OptionRow("mass_at", str, "Sensor at the added mass.", "NAME"),
    OptionRow("with_mass", list[Path], "Test with the added mass (repeatable).", "FRF"),
    OptionRow(
        *("sensor_mass", list[str]),
        "Mass that a sensor stands for, as tip=0.2 (repeatable); with --base, or with "
        "--fixture-mass.",
        "NAME=KG",
    ),
    OptionRow("fixture_mass", float, "Mass in kg of a free fixture that is forced."),
    OptionRow(
        *("known_shape", str),
        "Mass-normalised shape at a sensor, as midspan=11.84.",
        "NAME=VALUE",
    ),
    OptionRow(
        *("unscaled", bool),
        "Relative shapes: frequency and damping only.",
        *(None, False),
    ),
    OptionRow("newtons_per_volt", float, "Calibration of a drive voltage."),
    OptionRow("newtons_per_volt_std", float, "Its 1σ.", None, 0.0),
    OptionRow("calibration_std", float, "Relative 1σ of response over force.", None, 0.0),
    OptionRow("free", bool, "Structure free as a rigid body: write that mode.", None, False),
    OptionRow("mass", float, "Its mass in kg, if weighed (implies --free)."),
)
with_options(modes, {None: _DATA_ROWS, "Fit": _FIT_ROWS, "Scale of the shapes": _SCALE_ROWS})
