"""The command `demo`."""

import numpy as np

import snrmjax as sj
from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import Out
from snrmjax.io.models import write_model
from snrmjax.io.tables import write_steady_states
from snrmjax.io.units import HERTZ
from snrmjax.model.beams import FLAT_BEAM_FORCES


def demo(out: Out) -> None:
    """Run the whole chain on the built-in flat beam: simulate, test, identify, predict.

    Writes the model, simulated responses, the nonlinear normal mode, a virtual test with noise,
    all that `identify` makes of it, figures and report.html. Takes about a minute.
    """
    from snrmjax.io import results
    from snrmjax.report import workflow
    from snrmjax.report.figures import save_figure
    from snrmjax.report.simulation_figures import simulated_response_figure

    with staged(out) as folder:
        model = sj.model.flat_beam()
        write_model(folder / "model.toml", model)
        say("simulating the forced responses of the flat beam")
        curves = sj.forced_response(model, FLAT_BEAM_FORCES, 60 * HERTZ, 110 * HERTZ)
        results.write_response(
            folder / "response.csv",
            curves,
            sensor=model.modes.sensors[sj.identify.reference_sensor(model.modes)],
        )
        say("following its first nonlinear normal mode")
        branch = sj.nonlinear_normal_mode(model, 105 * HERTZ)
        results.write_normal_mode(
            folder / "nnm.csv",
            branch,
            sensor=model.modes.sensors[sj.identify.reference_sensor(model.modes)],
        )
        say("testing it near resonance, with noise")
        test = sj.phase_resonance_test(
            model,
            np.linspace(1.0e-3, 1.45e-2, 12).tolist(),
            60 * HERTZ,
            110 * HERTZ,
            recording=sj.simulate.Recording(
                errors=sj.simulate.MeasurementErrors(
                    amplitude=0.005, phase=np.radians(0.3), force=0.002
                ),
                seed=1,
                keep_harmonics=(3, 5),
            ),
        )
        data = test.steady_states
        write_steady_states(folder / "steady_states.csv", data)
        say("identifying backbone and damping, predicting responses")
        found = workflow.identify_by_points(data, model, workflow.Loads(FLAT_BEAM_FORCES))
        found = found._replace(truth=branch, simulated=tuple(curves))
        done = {"data": "a virtual test with seeded noise", "model": model.name}
        workflow.write_findings(folder, found, "The chain on the flat beam", done)
        save_figure(folder / "response.png", simulated_response_figure(curves))
    for note in found.notes:
        warn(note)
    for line in workflow.headline(found):
        say(line)
    say(f"written to {out}: open {out / 'report.html'}")
