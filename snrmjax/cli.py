"""The commands: demo, simulate, nnm, identify, diagnose.

Each imports what it needs by itself: none waits for the imports of another.
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import platformdirs
import typer
from rich.console import Console

import snrmjax as sj
from snrmjax.io.models import read_model, write_model
from snrmjax.io.tables import read_steady_states, write_steady_states
from snrmjax.io.units import HERTZ
from snrmjax.model.beams import FLAT_BEAM_FORCES
from snrmjax.simulate.continuation.continuation import STATUS_MESSAGE

app = typer.Typer(
    name="snrmjax",
    help="Backbones and damping of nonlinear normal modes from near-resonant steady states.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
_console = Console(stderr=True, highlight=False, soft_wrap=True)


class Amplitude(StrEnum):
    """At which amplitude an identified frequency and damping belong."""

    displacement = "displacement"
    velocity = "velocity"


class Measure(StrEnum):
    """Which amplitude of the measured motion enters the equations."""

    fundamental = "fundamental"
    peak = "peak"


class Family(StrEnum):
    """How a curve passes through its knots."""

    spline = "spline"
    piecewise_linear = "piecewise_linear"


class Tongues(StrEnum):
    """What to do where a normal mode runs out on an internal resonance and back."""

    follow = "follow"
    skip = "skip"


ModelFile = Annotated[Path, typer.Argument(help="Model of the structure (TOML).", metavar="MODEL")]
Out = Annotated[Path, typer.Option("--out", help="Folder for the results; made when missing.")]
Harmonics = Annotated[int, typer.Option(help="Number of harmonics.", min=1, max=99)]


@app.command()
def demo(out: Out) -> None:
    """Run the whole chain on the built-in flat beam: simulate, test, identify, predict.

    Writes the model, the simulated responses, the normal mode, a virtual measurement with noise,
    what `identify` makes of it, figures and report.html.
    """
    from snrmjax.io import results
    from snrmjax.report.figures import save_figure, simulated_response_figure
    from snrmjax.report.workflow import present_identification, write_identification

    with _staged(out) as folder:
        model = sj.model.flat_beam()
        write_model(folder / "model.toml", model)
        _say("simulating the forced responses of the flat beam")
        curves = sj.forced_response(model, FLAT_BEAM_FORCES, 60 * HERTZ, 110 * HERTZ)
        results.write_response(folder / "response.csv", model, curves)
        _say("following its first nonlinear normal mode")
        branch = sj.nonlinear_normal_mode(model, 105 * HERTZ)
        results.write_normal_mode(folder / "nnm.csv", model, branch)
        _say("testing it near resonance, with noise")
        test = sj.phase_resonance_test(
            model,
            np.linspace(1.0e-3, 1.45e-2, 12).tolist(),
            60 * HERTZ,
            110 * HERTZ,
            errors=sj.simulate.MeasurementErrors(
                amplitude=0.005, phase=np.radians(0.3), force=0.002
            ),
            seed=1,
            keep_harmonics=(3, 5),
        )
        data = test.steady_states
        write_steady_states(folder / "steady_states.csv", data)
        _say("identifying backbone and damping, predicting responses")
        told = present_identification(data, model, FLAT_BEAM_FORCES, truth=branch, simulated=curves)
        done = {"data": "a virtual test with seeded noise", "model": model.name}
        write_identification(folder, told, "The chain on the flat beam", done, ())
        save_figure(simulated_response_figure(curves), folder / "response.png")
    _say(f"done: open {out / 'report.html'}")


@app.command()
def simulate(
    model: ModelFile,
    force: Annotated[list[float], typer.Option(help="Force amplitude in N; repeat for more.")],
    from_hz: Annotated[float, typer.Option(help="Lowest frequency in Hz.")],
    to_hz: Annotated[float, typer.Option(help="Highest frequency in Hz.")],
    out: Out,
    harmonics: Harmonics = 9,
    isolated: Annotated[
        bool,
        typer.Option("--isolated", help="Also search for responses not connected to rest."),
    ] = False,
) -> None:
    """Simulate forced responses by harmonic balance, unstable parts included.

    Writes response.csv and response.png.
    """
    from snrmjax.io import results
    from snrmjax.report.figures import save_figure, simulated_response_figure

    with _staged(out) as folder:
        structure = read_model(model)
        _report_equilibria(structure)
        ends = (from_hz * HERTZ, to_hz * HERTZ)
        curves = []
        for number, one in enumerate(force):
            _say(f"force {one:g} N ({number + 1} of {len(force)})")
            main_curves = sj.forced_response(structure, [one], *ends, harmonic_order=harmonics)
            curves += main_curves
            if isolated:
                further = sj.simulate.isolated_responses(
                    structure, one, *ends, known=main_curves, harmonic_order=harmonics
                )
                _say(f"  {len(further)} further branches found")
                curves += further
        for curve in curves:
            if curve.branch == "main" and curve.status != sj.simulate.CurveStatus.UPPER_END:
                _warn(f"force {curve.force:g} N: {STATUS_MESSAGE[curve.status]}.")
        _report_truncation(curves, harmonics)
        if not any(len(curve.frequency) for curve in curves):
            raise ValueError("no response was found in this range; start farther from resonance.")
        results.write_response(folder / "response.csv", structure, curves)
        save_figure(
            simulated_response_figure(curves, sensor=_sensor(structure)), folder / "response.png"
        )


@app.command()
def nnm(
    model: ModelFile,
    to_hz: Annotated[float, typer.Option(help="Follow the mode to this frequency in Hz.")],
    out: Out,
    harmonics: Harmonics = 9,
    tongues: Annotated[
        Tongues, typer.Option(help="Tongues of internal resonances: follow or skip them.")
    ] = Tongues.follow,
) -> None:
    """Follow the nonlinear normal mode of interest from its linear frequency.

    Writes nnm.csv and nnm.png.
    """
    from snrmjax.io import results
    from snrmjax.report.figures import normal_mode_figure, save_figure

    with _staged(out) as folder:
        structure = read_model(model)
        _report_equilibria(structure)
        branch = sj.nonlinear_normal_mode(
            structure, to_hz * HERTZ, harmonic_order=harmonics, tongues=tongues.value
        )
        for tongue in branch.tongues:
            _say(
                f"internal resonance: harmonic {tongue.harmonic} drives mode {tongue.mode + 1} "
                f"from {tongue.from_frequency / HERTZ:.2f} to {tongue.to_frequency / HERTZ:.2f} Hz"
            )
        if branch.status not in (
            sj.simulate.CurveStatus.UPPER_END,
            sj.simulate.CurveStatus.LOWER_END,
        ):
            _warn(f"the mode {STATUS_MESSAGE[branch.status]}.")
        results.write_normal_mode(folder / "nnm.csv", structure, branch)
        save_figure(normal_mode_figure(branch, sensor=_sensor(structure)), folder / "nnm.png")


@app.command()
def identify(
    data: Annotated[Path, typer.Argument(help="Measured steady states (CSV).", metavar="DATA")],
    model: Annotated[Path, typer.Option(help="Linear model of the structure (TOML).")],
    out: Out,
    predict_force: Annotated[
        list[float] | None,
        typer.Option(help="Predict the response to this force in N; repeat for more."),
    ] = None,
    amplitude: Annotated[
        Amplitude,
        typer.Option(help="Backbone against displacement (right for stiffness) or velocity."),
    ] = Amplitude.displacement,
    measure: Annotated[
        Measure, typer.Option(help="Identify with the fundamental or with the peak amplitude.")
    ] = Measure.fundamental,
    curve: Annotated[Family, typer.Option(help="Family of the curves.")] = Family.spline,
    knots: Annotated[
        int | None,
        typer.Option(
            help="Knots of each curve; if not given, up to 60, and their smoothness is chosen by "
            "how well left-out levels are predicted.",
            min=2,
        ),
    ] = None,
    anchor: Annotated[
        bool, typer.Option("--anchor", help="Pin the curves at the linear mode at zero amplitude.")
    ] = False,
    fit: Annotated[
        str | None,
        typer.Option(
            help="Fit both curves jointly: BACKBONE[,DAMPING], each a family such as polynomial, "
            "spline:5 or viscous_quadratic@velocity, or auto.",
            metavar="FAMILY[,FAMILY]",
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            help="Let the joint fit find force_gain, force_offset or instrument_phase, or several.",
            metavar="NAME[,NAME]",
        ),
    ] = None,
    advise: Annotated[
        int | None,
        typer.Option("--next", help="Advise this many next measurements (joint fit).", min=1),
    ] = None,
    robust: Annotated[
        bool, typer.Option("--robust", help="Mistrust outlying states (joint fit).")
    ] = False,
) -> None:
    """Identify backbone and damping from measured steady states, and predict responses.

    Writes points.csv, backbone.csv, summary.json, figures and report.html; with --predict-force
    also prediction.csv; with --fit the fitted curves, their residuals, what their bands are made of
    and fit.json, and with --next also next.csv.
    """
    from snrmjax.io import joint_results
    from snrmjax.report.workflow import (
        corrected,
        fit_as_asked,
        present_identification,
        write_identification,
    )

    with _staged(out) as folder:
        structure = read_model(model)
        measured = read_steady_states(data, structure)
        notes = measured.notes
        for note in notes:
            _warn(note)
        joint: sj.identify.JointFit | None = None
        advice: tuple[sj.identify.NextMeasurement, ...] = ()
        if fit is not None or free or advise:
            joint = fit_as_asked(measured, structure, fit or "auto", free or [], robust=robust)
            measured = corrected(measured, joint)
            advice = tuple(sj.next_measurements(joint, advise)) if advise else ()
        told = present_identification(
            measured,
            structure,
            predict_force or [],
            fit=joint,
            advice=advice,
            amplitude=amplitude.value,
            measure=measure.value,
            family=curve.value,
            n_knots=knots,
            anchor=anchor,
        )
        for note in told.notes:
            _warn(note)
        done = {
            "data": data.name,
            "model": f"{structure.name} ({model.name})",
            "amplitude": f"{amplitude.value}, {measure.value}",
            "curves": curve.value + (", anchored at the linear mode" if anchor else ""),
        }
        further: dict[str, object] = {}
        if joint is not None:
            pair = (joint.unknowns.squared_frequency, joint.unknowns.modal_damping)
            done["curves"] = " and ".join(joint_results.described(curve) for curve in pair)
            responses = [
                r for f in predict_force or [] for r in sj.identify.fitted_response(joint, f)
            ]
            shares = told.fitted.shares if told.fitted else ()
            further["joint_fit"] = joint_results.summarise_fit(joint, responses, shares)
            joint_results.write_joint_fit(folder / "fit.json", joint)
        if advise:
            joint_results.write_next(folder / "next.csv", advice)
            for one in advice:
                hertz = f"{one.frequency / HERTZ:.6g} Hz"
                _say(f"{one.rank}. {one.force:.4g} N at {hertz}: {one.reason}")
        write_identification(*(folder, told, data.stem.replace("_", " "), done, notes), further)
        if joint is not None:
            joint_results.write_fitted_backbone(folder / "backbone.csv", joint)


@app.command()
def diagnose(
    data: Annotated[
        list[Path],
        typer.Argument(help="Measured steady states (CSV), one or more.", metavar="DATA"),
    ],
    model: Annotated[Path, typer.Option(help="Model of the structure as it is believed (TOML).")],
    out: Out,
    responses: Annotated[
        bool | None,
        typer.Option(
            help="Also simulate the responses before and after; if not said, for a single file."
        ),
    ] = None,
) -> None:
    """Find the physics that a model lacks: where it disagrees with the data, what that is.

    Writes diagnosis.json, figures, report.html and the completed model.toml; of several files each
    into a folder of its own, with the model of the same name beside the file if there is one.

    Without phases: velocity_m_s, the amplitude of the fundamental, in place of velocity_re_m_s and
    velocity_im_m_s; or a phase_std_deg of 60 or more. The notes say what is lost.
    """
    from snrmjax.report.diagnosis_report import write_diagnosis

    several = len(data) > 1
    if len({path.stem for path in data}) < len(data):
        raise ValueError("two of the data files have the same name: they would share a folder.")
    refused = []
    for path in data:
        beside = path.with_suffix(".toml")
        own = beside if several and beside.exists() else model
        try:
            with _staged(out / path.stem if several else out) as folder:
                structure = read_model(own)
                measured = read_steady_states(path, structure)
                for note in measured.notes:
                    _warn(note)
                simulate = not several if responses is None else responses
                found = write_diagnosis(folder, path.stem, structure, measured, simulate=simulate)
        except ValueError as error:
            if not several:
                raise
            _warn(f"{path.name}: {error}")
            refused.append(path.name)
            continue
        effects = f" ({', '.join(found.effects)})" if found.effects else ""
        _say(f"{path.name}: {found.verdict.replace('_', ' ')}{effects}")
        if found.decide_by:
            _say(f"  what would decide: {found.decide_by}")
    if refused:
        raise ValueError(f"no diagnosis for {len(refused)} of {len(data)}: {', '.join(refused)}.")


def main() -> None:
    """Run the commands; wrong input ends with exit code 2 and one sentence."""
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR") or platformdirs.user_cache_dir("snrmjax")
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    try:
        app()
    except ValueError as error:
        _console.print(f"error: {error}", style="red", markup=False)
        sys.exit(2)


def _sensor(structure: sj.model.Structure) -> str:
    return structure.modes.sensors[sj.identify.reference_sensor(structure.modes)]


def _report_truncation(curves: list[sj.simulate.ResponseCurve], harmonics: int) -> None:
    """Say where the harmonics that are left out would matter."""
    worst = max(
        (float(np.max(c.truncation, initial=0.0)) for c in curves if c.truncation is not None),
        default=0.0,
    )
    if worst > 0.02:
        _warn(
            f"the harmonics above {harmonics} would change the velocity by up to about "
            f"{100 * worst:.0f} % somewhere; use more --harmonics."
        )


def _report_equilibria(structure: sj.model.Structure) -> None:
    from snrmjax.report.workflow import equilibria_notes

    for note in equilibria_notes(structure):
        _warn(note)


@contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """A folder to write into whose files move to `out` together, or not at all."""
    out = Path(os.path.abspath(out))
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file, but a folder is expected.")
    made = [p for p in (out, *out.parents) if not p.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".snrmjax-", dir=out))
    except OSError as error:
        raise ValueError(f"--out {out} cannot be written: {error.strerror}.") from error
    done = False
    try:
        yield staging
        for file in sorted(staging.iterdir()):
            os.replace(file, out / file.name)
        done = True
    finally:
        shutil.rmtree(staging)
        if not done:
            for folder in made:
                folder.rmdir()


def _say(message: str) -> None:
    _console.print(message, markup=False)


def _warn(message: str) -> None:
    _console.print(f"note: {message}", style="yellow", markup=False)
