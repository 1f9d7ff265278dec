"""Which figure shows which result: what `result.plot()` draws."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.report.figures import diagnosis as diagnosis_figures
from snrmjax.report.figures import identification as figures
from snrmjax.report.figures import joint_fit as joint_figures
from snrmjax.report.figures import simulation as simulation_figures
from snrmjax.report.figures import uncertainty as uncertainty_figures
from snrmjax.report.figures.modes import decay_figure, modal_responses_figure
from snrmjax.report.figures.reduction import scale_figure, static_figure
from snrmjax.report.figures.simulation import (
    amplitudes_figure,
    motions_figure,
    simulated_response_figure,
)
from snrmjax.report.sampling import sensor_index, span_of


def plot_result(result: object, **settings: Any) -> Figure:
    """The figure that shows a result.

    Raises `ValueError` for results that no figure shows.
    """
    for one in type(result).__mro__:
        if one.__name__ in _FIGURES:
            return _FIGURES[one.__name__](result, **settings)
    raise InputError(f"there is no figure of a `{type(result).__name__}`; see `sj.plot`.")


def _states(states: Any, *, sensor: str | None = None) -> Figure:
    name = sensor or states.sensors[0]
    velocity = np.asarray(states.velocity)[:, sensor_index(states.sensors, name)]
    return motions_figure(np.asarray(states.frequency), velocity, sensor=name, joined=False)


def _motions(found: Any) -> Figure:
    velocity = np.ravel(found.velocity[..., 1, 0])
    return motions_figure(np.ravel(found.frequency), velocity, joined=False)


def _predicted(response: Any) -> Figure:
    figure = motions_figure(
        *(response.frequency, response.velocity),
        sensor="the backbone's sensor",
        joined=True,
        stable=response.stable,
        beyond=response.continued,
    )
    low, high = span_of(response, "")
    figure.axes[0].set_xlim(low / HERTZ, high / HERTZ)
    return figure


def _identified_points(points: Any) -> Figure:
    return amplitudes_figure(
        *(points.backbone_velocity, points.natural_frequency, points.damping_ratio),
        points.sensor,
        stds=(points.natural_frequency_std, points.damping_ratio_std),
        joined=False,
    )


def _curves(values: Any, *, sensor: str = "the sensor") -> Figure:
    return amplitudes_figure(
        *(values.velocity, values.natural_frequency, values.damping_ratio),
        sensor,
        stds=(values.natural_frequency_std, values.damping_ratio_std),
    )


def _residuals(found: Any) -> Figure:
    """Whitened residuals: within ±2 for 95 % where model and noise are right."""
    return simulation_figures.points_figure(
        *(np.arange(len(found.residuals)), found.residuals),
        *("residuals", "Steady state", "Residual (1σ)"),
        limits=(-2.0, 2.0),
    )


# By the names of classes: none of them is imported before there is a result of it.
_FIGURES: dict[str, Callable[..., Figure]] = {
    "Backbone": lambda one: _curves(one.sampled(), sensor=one.sensor),
    "BackbonePoints": _identified_points,
    "BackboneValues": _curves,
    "CalibratedModel": _residuals,
    "Condensation": lambda one: static_figure(one, [f"mode {n}" for n in one.basis.numbers]),
    "Contributions": lambda one: joint_figures.contributions_figure(one.rows),
    "ControlledCurve": lambda one: motions_figure(
        one.frequency, one.velocity[:, 1, 0], sensor=one.sensors[0], joined=True
    ),
    "DampedModeBranch": simulation_figures.damped_mode_figure,
    "DecayModes": decay_figure,
    "Diagnosis": diagnosis_figures.misfit_figure,
    "EventCurve": lambda one, **settings: simulation_figures.event_curve_figure([one], **settings),
    "FittedResponse": lambda one: joint_figures.next_measurements_figure(
        [one], [], sensor=one.sensor
    ),
    "Identification": lambda one, **settings: figures.backbone_figure(
        one.points, one.backbone, **settings
    ),
    "InverseForce": lambda one: simulation_figures.force_velocity_points(
        np.asarray(one.force), np.asarray(one.velocity)[:, 1, 0]
    ),
    "IsolatedResponses": lambda one, **settings: simulated_response_figure(one.curves, **settings),
    "JointFit": lambda one, **settings: joint_figures.fitted_curves_figure(
        [joint_figures.FitSeries("joint fit", one)], **settings
    ),
    "LinearModalFit": modal_responses_figure,
    "LoadScaleStudy": scale_figure,
    "NextMeasurements": lambda one: joint_figures.next_measurements_figure(
        one.responses, one.rows, sensor=one.sensor
    ),
    "NormalModeBranch": simulation_figures.normal_mode_figure,
    "PeriodicMotion": _motions,
    "PredictedResponse": _predicted,
    "Propagation": uncertainty_figures.propagation_figure,
    "QuasiPeriodicBranch": lambda one, **settings: simulation_figures.quasi_periodic_figure(
        [one], **settings
    ),
    "ResponseBatch": simulation_figures.batch_figure,
    "ResponseCurve": lambda one, **settings: simulated_response_figure([one], **settings),
    "SobolIndices": uncertainty_figures.sensitivity_figure,
    "SteadyStates": _states,
    "VirtualTest": lambda one: _states(one.steady_states),
}
