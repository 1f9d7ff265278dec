"""The command `demo`."""

import snrmjax as sj
from snrmjax.cli.console import print_line, print_result, written
from snrmjax.cli.options import Out
from snrmjax.report.writing import staged


def demo(out: Out) -> None:
    """Run the whole chain on the built-in flat beam.

    Simulates, tests, identifies and predicts. Writes the model, simulated responses, the nonlinear
    normal mode, a virtual test with noise, all results of `identify`, figures and
    report.html. Takes about a minute.
    """
    import numpy as np

    from snrmjax.io import results
    from snrmjax.io.models import write_model
    from snrmjax.io.tables import write_steady_states
    from snrmjax.model.builders.beams import FLAT_BEAM_FORCES
    from snrmjax.numerics.units import HERTZ
    from snrmjax.pipelines.identify import identify_test
    from snrmjax.report.figures.simulation import simulated_response_figure
    from snrmjax.report.pages import identified_test as page
    from snrmjax.report.style import save_figure

    with staged(out) as folder:
        model = sj.model.flat_beam()
        write_model(folder / "model.toml", model)
        print_line("simulating the forced responses of the flat beam")
        curves = sj.forced_response(model, FLAT_BEAM_FORCES, 60 * HERTZ, 110 * HERTZ)
        sensor = model.modes.sensors[sj.identify.reference_sensor(model.modes)]
        results.write_response(folder / "response.csv", curves, sensor=sensor)
        print_line("following its first nonlinear normal mode")
        branch = sj.nonlinear_normal_mode(model, 105 * HERTZ)
        results.write_normal_mode(folder / "nnm.csv", branch, sensor=sensor)
        print_line("testing it near resonance, with noise")
        errors = sj.simulate.MeasurementErrors(amplitude=0.005, phase=np.radians(0.3), force=0.002)
        test = sj.phase_resonance_test(
            model,
            np.linspace(1.0e-3, 1.45e-2, 12).tolist(),
            60 * HERTZ,
            110 * HERTZ,
            recording=sj.simulate.Recording(errors=errors, seed=1, keep_harmonics=(3, 5)),
        )
        data = test.steady_states
        write_steady_states(folder / "steady_states.csv", data)
        print_line("identifying backbone and damping, predicting responses")
        identified = identify_test(data, model, predict_force=tuple(FLAT_BEAM_FORCES))
        identified = identified._replace(truth=branch, simulated=tuple(curves))
        source = "a virtual test with seeded noise"
        page.write(folder, identified, title="The chain on the flat beam", data=source)
        save_figure(folder / "response.png", simulated_response_figure(curves))
    print_result(identified)
    written(out)
