"""Which figure shows which result: what `result.plot()` draws."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from snrmjax.condense.condensation import Condensation
from snrmjax.condense.scale_study import LoadScaleStudy
from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.identify.calibrate.calibrated_model import CalibratedModel
from snrmjax.identify.calibrate.inverse_force import InverseForce
from snrmjax.identify.inference.contributions import Contributions
from snrmjax.identify.inference.fitted_response import FittedResponse
from snrmjax.identify.inference.identification import Identification
from snrmjax.identify.inference.optimal_design import NextMeasurements
from snrmjax.identify.inference.refits import Profile
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.pointwise.backbone import Backbone, BackboneValues
from snrmjax.identify.pointwise.points_result import BackbonePoints
from snrmjax.identify.pointwise.prediction_result import PredictedResponse
from snrmjax.io.units import HERTZ
from snrmjax.measure.equivalent_force import EquivalentForce
from snrmjax.measure.force_calibration import ForceCalibration
from snrmjax.measure.harmonic_fit import HarmonicFit
from snrmjax.measure.states import SteadyStates
from snrmjax.report import diagnosis_figures, figures, joint_figures, simulation_figures
from snrmjax.report.condense.reduction_figures import scale_figure, static_figure
from snrmjax.report.modal.modal_figures import decay_figure, modal_responses_figure
from snrmjax.report.sampling import span_of
from snrmjax.report.uncertainty import uncertainty_figures
from snrmjax.simulate.continuation.response_curve import ResponseCurve
from snrmjax.simulate.solutions.controlled import ControlledCurve, DampedModeBranch
from snrmjax.simulate.solutions.forced_response import ResponseBatch
from snrmjax.simulate.solutions.isolated_responses import IsolatedResponses
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch
from snrmjax.simulate.solutions.periodic_motion import PeriodicMotion
from snrmjax.simulate.solutions.time_integration import IntegratedMotion
from snrmjax.simulate.virtual_test.phase_resonance_test import VirtualTest
from snrmjax.study.uncertainty.propagation import Propagation
from snrmjax.study.uncertainty.sensitivity import SobolIndices


@functools.singledispatch
def plot_result(result: object, **settings: Any) -> Figure:
    """The figure that shows a result.

    Raises `ValueError` for results that no figure shows.
    """
    raise ValueError(f"there is no figure of a `{type(result).__name__}`; see `sj.plot`.")


@plot_result.register
def _(result: NextMeasurements) -> Figure:
    return joint_figures.next_measurements_figure(
        result.responses, result.rows, sensor=result.sensor
    )


@plot_result.register
def _(result: ResponseCurve, **settings: Any) -> Figure:
    return simulation_figures.simulated_response_figure([result], **settings)


@plot_result.register
def _(result: IsolatedResponses, **settings: Any) -> Figure:
    return simulation_figures.simulated_response_figure(result.curves, **settings)


@plot_result.register
def _(result: ResponseBatch, **settings: Any) -> Figure:
    return simulation_figures.batch_figure(result, **settings)


@plot_result.register
def _(result: NormalModeBranch, **settings: Any) -> Figure:
    return simulation_figures.normal_mode_figure(result, **settings)


@plot_result.register
def _(result: DampedModeBranch, **settings: Any) -> Figure:
    return simulation_figures.damped_mode_figure(result, **settings)


@plot_result.register
def _(result: ControlledCurve) -> Figure:
    velocity, sensor = result.velocity[:, 1, 0], result.sensors[0]
    return simulation_figures.motions_figure(result.frequency, velocity, sensor=sensor, joined=True)


@plot_result.register(PeriodicMotion)
@plot_result.register(IntegratedMotion)
def _(result: PeriodicMotion | IntegratedMotion) -> Figure:
    frequency, velocity = np.ravel(result.frequency), np.ravel(result.velocity[..., 1, 0])
    return simulation_figures.motions_figure(frequency, velocity, joined=False)


@plot_result.register
def _(result: VirtualTest) -> Figure:
    states = result.steady_states
    frequency, velocity = np.asarray(states.frequency), np.asarray(states.velocity)[:, 0]
    sensor = states.sensors[0]
    return simulation_figures.motions_figure(frequency, velocity, sensor=sensor, joined=False)


@plot_result.register
def _(result: Diagnosis, **settings: Any) -> Figure:
    return diagnosis_figures.misfit_figure(result, **settings)


@plot_result.register
def _(result: Identification, **settings: Any) -> Figure:
    return figures.backbone_figure(result.points, result.backbone, **settings)


@plot_result.register
def _(result: BackbonePoints) -> Figure:
    return simulation_figures.amplitudes_figure(
        *(result.backbone_velocity, result.natural_frequency, result.damping_ratio),
        result.sensor,
        stds=(result.natural_frequency_std, result.damping_ratio_std),
        joined=False,
    )


@plot_result.register
def _(result: Backbone) -> Figure:
    return plot_result(result.sampled(), sensor=result.sensor)


@plot_result.register
def _(result: BackboneValues, *, sensor: str = "the sensor") -> Figure:
    return simulation_figures.amplitudes_figure(
        *(result.velocity, result.natural_frequency, result.damping_ratio),
        sensor,
        stds=(result.natural_frequency_std, result.damping_ratio_std),
    )


@plot_result.register
def _(result: PredictedResponse) -> Figure:
    figure = simulation_figures.motions_figure(
        *(result.frequency, result.velocity),
        sensor="the backbone's sensor",
        joined=True,
        stable=result.stable,
        beyond=result.continued,
    )
    low, high = span_of(result, "")
    figure.axes[0].set_xlim(low / HERTZ, high / HERTZ)
    return figure


@plot_result.register
def _(result: SteadyStates, *, sensor: str | None = None) -> Figure:
    name = sensor or result.sensors[0]
    if name not in result.sensors:
        raise ValueError(f"`sensor` must be one of {result.sensors}, but is {name!r}.")
    velocity = np.asarray(result.velocity)[:, result.sensors.index(name)]
    frequency = np.asarray(result.frequency)
    return simulation_figures.motions_figure(frequency, velocity, sensor=name, joined=False)


@plot_result.register
def _(result: JointFit, **settings: Any) -> Figure:
    series = [joint_figures.FitSeries("joint fit", result)]
    return joint_figures.fitted_curves_figure(series, **settings)


@plot_result.register
def _(result: FittedResponse) -> Figure:
    return joint_figures.next_measurements_figure([result], [], sensor=result.sensor)


@plot_result.register
def _(result: Contributions, **settings: Any) -> Figure:
    return joint_figures.contributions_figure(result.rows, **settings)


@plot_result.register
def _(result: Profile, **settings: Any) -> Figure:
    return joint_figures.profile_figure(result, **settings)


@plot_result.register
def _(result: InverseForce) -> Figure:
    velocity = np.asarray(result.velocity)[:, 1, 0]
    return simulation_figures.force_velocity_points(np.asarray(result.force), velocity)


@plot_result.register
def _(result: CalibratedModel) -> Figure:
    return simulation_figures.residual_columns_figure(result.residuals)


@plot_result.register
def _(result: HarmonicFit) -> Figure:
    amplitude = np.abs(np.asarray(result.amplitude)).reshape(-1, len(result.harmonic_order))
    return simulation_figures.bars_figure(
        result.harmonic_order, amplitude, "Harmonic order", "Amplitude (unit of the record)"
    )


@plot_result.register
def _(result: EquivalentForce) -> Figure:
    return simulation_figures.line_figure(
        *map(np.asarray, (result.drive, result.force, result.force_std))
    )


@plot_result.register
def _(result: ForceCalibration, *, largest_drive: float = 1.0) -> Figure:
    drive = jnp.asarray(np.linspace(0.0, largest_drive, 50))
    given = map(np.asarray, (drive, result.force(drive), result.force_std(drive)))
    return simulation_figures.line_figure(*given, joined=True)


@plot_result.register
def _(result: Propagation) -> Figure:
    return uncertainty_figures.propagation_figure(result)


@plot_result.register
def _(result: SobolIndices) -> Figure:
    return uncertainty_figures.sensitivity_figure(result)


@plot_result.register
def _(result: Condensation) -> Figure:
    return static_figure(result, [f"mode {number}" for number in result.basis.numbers])


@plot_result.register
def _(result: LoadScaleStudy) -> Figure:
    return scale_figure(result)


@plot_result.register
def _(result: LinearModalFit, **settings: Any) -> Figure:
    return modal_responses_figure(result, **settings)


@plot_result.register
def _(result: DecayModes) -> Figure:
    return decay_figure(result)
