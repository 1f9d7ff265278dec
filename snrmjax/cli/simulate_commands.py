"""The commands `simulate` and `nnm`: what a model does."""

from typing import Annotated, Literal

import numpy as np
import typer

import snrmjax as sj
from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import Harmonics, Model, Out, require_positive
from snrmjax.io.models import read_model
from snrmjax.io.units import HERTZ


def simulate(
    model: Model,
    force: Annotated[
        list[float],
        typer.Option(
            help="Peak amplitude of the harmonic force in N; give it again for further forces.",
            metavar="N",
            show_default=False,
        ),
    ],
    from_hz: Annotated[
        float,
        typer.Option(help="Lowest frequency of the force in Hz.", metavar="HZ", show_default=False),
    ],
    to_hz: Annotated[
        float,
        typer.Option(
            help="Highest frequency of the force in Hz.", metavar="HZ", show_default=False
        ),
    ],
    out: Out,
    harmonics: Harmonics = 9,
    isolated: Annotated[
        bool,
        typer.Option(
            "--isolated",
            help="Also search for responses that are not connected to those of small motion "
            "(takes longer).",
        ),
    ] = False,
) -> None:
    """Simulate responses to a harmonic force, around their folds and with unstable parts.

    Harmonic balance with arclength continuation. Writes response.csv and response.png.
    """
    from snrmjax.io import results
    from snrmjax.report.figures import save_figure
    from snrmjax.report.simulation_figures import simulated_response_figure

    if not 0 < from_hz < to_hz:
        raise ValueError(
            "`--from-hz` must be above zero and below `--to-hz`, but they are "
            f"{from_hz:g} and {to_hz:g} Hz."
        )
    require_positive("--force", force, "N")
    with staged(out) as folder:
        structure = read_model(model)
        _report_equilibria(structure)
        ends = (from_hz * HERTZ, to_hz * HERTZ)
        curves = []
        for number, one in enumerate(force):
            say(f"force {one:g} N ({number + 1} of {len(force)})")
            main_curves = sj.forced_response(structure, [one], *ends, harmonic_order=harmonics)
            curves += main_curves
            if isolated:
                further = sj.simulate.isolated_responses(
                    *(structure, one, *ends),
                    known=main_curves,
                    settings=sj.simulate.ResponseSettings(harmonic_order=harmonics),
                )
                say(f"  {len(further)} further branches found; {further.summary()[-1]}")
                curves += further
        for curve in curves:
            if curve.branch == "main" and curve.status != sj.simulate.CurveStatus.UPPER_END:
                warn(f"force {curve.force:g} N: {curve.status.message}.")
            if curve.not_located:
                warn(f"force {curve.force:g} N: not located: {', '.join(curve.not_located)}.")
            unknown = int(np.sum(curve.stability == sj.simulate.Stability.NOT_COMPUTED))
            if unknown:
                warn(
                    f"force {curve.force:g} N: the stability of {unknown} points could not be"
                    " computed; response.csv has 0 there and says so in `event`."
                )
        _report_truncation(curves, harmonics)
        if not any(len(curve.frequency) for curve in curves):
            raise ValueError("no response was found in this range; start farther from resonance.")
        sensor = _sensor(structure)
        results.write_response(folder / "response.csv", curves, sensor=sensor)
        save_figure(folder / "response.png", simulated_response_figure(curves, sensor=sensor))
    for curve in curves:
        say(_headline(curve, sensor))
    say(f"written to {out}")


def nnm(
    model: Model,
    to_hz: Annotated[
        float,
        typer.Option(
            help="Frequency in Hz at which to stop, above the linear one or, for a mode that "
            "softens, below it.",
            metavar="HZ",
            show_default=False,
        ),
    ],
    out: Out,
    harmonics: Harmonics = 9,
    tongues: Annotated[
        Literal["follow", "skip"],
        typer.Option(
            help="Where an internal resonance lets the mode run out and back: follow this tongue, "
            "or skip it."
        ),
    ] = "follow",
) -> None:
    """Follow the undamped nonlinear normal mode of interest from its linear frequency.

    Writes nnm.csv (frequency, velocity, energy) and nnm.png.
    """
    from snrmjax.io import results
    from snrmjax.report.figures import save_figure
    from snrmjax.report.simulation_figures import normal_mode_figure

    require_positive("--to-hz", [to_hz], "Hz")
    with staged(out) as folder:
        structure = read_model(model)
        linear = float(structure.modes.natural_frequency[structure.modes.mode_of_interest]) / HERTZ
        if np.isclose(to_hz, linear, rtol=1e-12):
            raise ValueError(f"`--to-hz` must differ from the linear frequency, {linear:g} Hz.")
        _report_equilibria(structure)
        branch = sj.nonlinear_normal_mode(
            structure, to_hz * HERTZ, harmonic_order=harmonics, tongues=tongues
        )
        for tongue in branch.tongues:
            say(
                f"internal resonance: harmonic {tongue.harmonic} drives mode {tongue.mode + 1} "
                f"from {tongue.from_frequency / HERTZ:.2f} to {tongue.to_frequency / HERTZ:.2f} Hz"
            )
        if branch.status not in (
            sj.simulate.CurveStatus.UPPER_END,
            sj.simulate.CurveStatus.LOWER_END,
        ):
            warn(f"the mode {branch.status.message}.")
        sensor = _sensor(structure)
        results.write_normal_mode(folder / "nnm.csv", branch, sensor=sensor)
        save_figure(folder / "nnm.png", normal_mode_figure(branch, sensor=sensor))
    speed = np.abs(branch.velocity[-1, 1, branch.sensors.index(sensor)])
    say(f"the mode ends at {branch.frequency[-1] / HERTZ:.5g} Hz, {speed:.3g} m/s at {sensor}")
    say(f"written to {out}")


def _sensor(structure: sj.model.Structure) -> str:
    return structure.modes.sensors[sj.identify.reference_sensor(structure.modes)]


def _headline(curve: sj.simulate.ResponseCurve, sensor: str) -> str:
    """The largest response of a curve in one line."""
    speed = np.abs(curve.velocity[:, 1, curve.sensors.index(sensor)])
    name = "" if curve.branch == "main" else f" ({curve.branch})"
    if not speed.size:
        return f"force {curve.force:g} N{name}: no response"
    top = int(np.argmax(speed))
    return (
        f"force {curve.force:g} N{name}: {speed[top]:.4g} m/s at {sensor} at most, at "
        f"{curve.frequency[top] / HERTZ:.5g} Hz; {len(curve.at_events('fold'))} folds"
    )


def _report_truncation(curves: list[sj.simulate.ResponseCurve], harmonics: int) -> None:
    """Say where the harmonics that are left out would matter."""
    worst = max(
        (float(np.max(c.truncation, initial=0.0)) for c in curves if c.truncation is not None),
        default=0.0,
    )
    if worst > 0.02:
        warn(
            f"the harmonics above {harmonics} would change the velocity by up to about "
            f"{100 * worst:.0f} % somewhere; use more --harmonics."
        )


def _report_equilibria(structure: sj.model.Structure) -> None:
    from snrmjax.report.simulation_figures import equilibria_notes

    for note in equilibria_notes(structure):
        warn(note)
