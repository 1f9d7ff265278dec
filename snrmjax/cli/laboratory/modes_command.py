"""The command `modes`: linear modes from frequency responses, low levels and decays."""

from pathlib import Path
from typing import Annotated, Any

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.laboratory.modal_sources import asked_scale, read_modal_sources, sensor_values
from snrmjax.cli.options import FILES
from snrmjax.io.units import HERTZ

_FIT, _SCALE = "Fit", "Scale of the shapes"


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
    reference: Annotated[
        str | None, typer.Option(help="Reference channel where there are several.", metavar="NAME")
    ] = None,
    level: Annotated[
        int | None, typer.Option(help="Level of steady states (default: the lowest).")
    ] = None,
    from_hz: Annotated[
        float | None, typer.Option(help="Lower end of the band.", rich_help_panel=_FIT)
    ] = None,
    to_hz: Annotated[
        float | None,
        typer.Option(help="Upper end of the band; decays are thinned to it.", rich_help_panel=_FIT),
    ] = None,
    poles: Annotated[
        str | None,
        typer.Option(
            help="Natural frequencies in Hz by hand, as 79.0,427.5.",
            metavar="HZ,…",
            rich_help_panel=_FIT,
        ),
    ] = None,
    order: Annotated[
        int | None, typer.Option(help="Take the poles of one model order.", rich_help_panel=_FIT)
    ] = None,
    highest_order: Annotated[
        int | None, typer.Option(help="Highest model order.", rich_help_panel=_FIT)
    ] = None,
    residuals: Annotated[
        str,
        typer.Option(
            help="Residual terms of modes outside the band: auto, both, lower, upper, none.",
            rich_help_panel=_FIT,
        ),
    ] = "auto",
    window: Annotated[
        str | None,
        typer.Option(
            help="hann: model the leakage of averages of random excitation.", rich_help_panel=_FIT
        ),
    ] = None,
    instrument_phase: Annotated[
        bool | None,
        typer.Option(
            help="Free a phase of the instruments (default: over a voltage only).",
            rich_help_panel=_FIT,
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            help="The reference is the motion of a base, the responses are: absolute, relative.",
            metavar="KIND",
            rich_help_panel=_FIT,
        ),
    ] = None,
    drive_point: Annotated[
        str | None,
        typer.Option(
            help="Sensor at the force (default: by point and axis).",
            metavar="NAME",
            rich_help_panel=_SCALE,
        ),
    ] = None,
    turned: Annotated[
        bool,
        typer.Option(
            "--turned",
            help="The drive point's sensor is against the force.",
            rich_help_panel=_SCALE,
        ),
    ] = False,
    added_mass: Annotated[
        float | None,
        typer.Option(help="Added mass in kg of a second test.", rich_help_panel=_SCALE),
    ] = None,
    mass_at: Annotated[
        str | None,
        typer.Option(help="Sensor at the added mass.", metavar="NAME", rich_help_panel=_SCALE),
    ] = None,
    with_mass: Annotated[
        list[Path] | None,
        typer.Option(
            help="Test with the added mass (repeatable).", metavar="FRF", rich_help_panel=_SCALE
        ),
    ] = None,
    sensor_mass: Annotated[
        list[str] | None,
        typer.Option(
            help="Mass that a sensor stands for, as tip=0.2 (repeatable); with --base, or with "
            "--fixture-mass.",
            metavar="NAME=KG",
            rich_help_panel=_SCALE,
        ),
    ] = None,
    fixture_mass: Annotated[
        float | None,
        typer.Option(help="Mass in kg of a free fixture that is forced.", rich_help_panel=_SCALE),
    ] = None,
    known_shape: Annotated[
        str | None,
        typer.Option(
            help="Mass-normalised shape at a sensor, as midspan=11.84.",
            metavar="NAME=VALUE",
            rich_help_panel=_SCALE,
        ),
    ] = None,
    unscaled: Annotated[
        bool,
        typer.Option(
            "--unscaled",
            help="Relative shapes: frequency and damping only.",
            rich_help_panel=_SCALE,
        ),
    ] = False,
    newtons_per_volt: Annotated[
        float | None,
        typer.Option(help="Calibration of a drive voltage.", rich_help_panel=_SCALE),
    ] = None,
    newtons_per_volt_std: Annotated[
        float, typer.Option(help="Its 1σ.", rich_help_panel=_SCALE)
    ] = 0.0,
    calibration_std: Annotated[
        float,
        typer.Option(help="Relative 1σ of response over force.", rich_help_panel=_SCALE),
    ] = 0.0,
    free: Annotated[
        bool,
        typer.Option(
            "--free",
            help="Structure free as a rigid body: write that mode.",
            rich_help_panel=_SCALE,
        ),
    ] = False,
    mass: Annotated[
        float | None,
        typer.Option(help="Its mass in kg, if weighed (implies --free).", rich_help_panel=_SCALE),
    ] = None,
) -> None:
    """Find linear modes with their errors and write them as a model.

    Poles of all model orders are fitted to all responses together; shapes are mass-normalised by
    the drive point, an added mass, masses at the sensors or a known shape, or refused.

    Writes the model (TOML), modes.csv and report.html.
    """
    from snrmjax.identify.modal.modes_of_tests import find_modes
    from snrmjax.identify.scaling.scale import (
        Calibration,
        DrivePoint,
        Free,
        scale_modes,
    )
    from snrmjax.report.modal.modal_report import modes_sentence, write_linear_modes

    if out.suffix.lower() != ".toml":
        raise ValueError(f"--out must be a model to write (.toml), but is {out.name!r}.")
    if out.is_dir():
        raise ValueError(f"--out {out} is a folder, but a file to write is expected.")
    settings: dict[str, Any] = {
        "level": level,
        "base": base,
        "reference": reference,
        "from_frequency": None if from_hz is None else from_hz * HERTZ,
        "to_frequency": None if to_hz is None else to_hz * HERTZ,
        "poles": _poles(poles),
        "order": order,
        "highest_order": highest_order,
        "residual_terms": residuals,
        "window": window,
        "instrument_phase": instrument_phase,
    }
    calibration = Calibration(newtons_per_volt, newtons_per_volt_std, calibration_std)
    with staged(out.parent) as folder:
        found, notes = find_modes(read_modal_sources(data), **settings)
        second = find_modes(read_modal_sources(with_mass), **settings)[0] if with_mass else None
        scale = asked_scale(
            DrivePoint(drive_point, turned),
            unscaled=unscaled,
            added_mass=added_mass,
            mass_at=mass_at,
            with_mass=second,
            sensor_mass=sensor_values("--sensor-mass", sensor_mass or ()),
            fixture_mass=fixture_mass,
            known_shape=sensor_values(
                "--known-shape", () if known_shape is None else (known_shape,)
            ),
        )
        body = Free(mass) if free or mass is not None else None
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
