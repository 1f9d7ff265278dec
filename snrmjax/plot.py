"""Figures of measured, identified, simulated and diagnosed results."""

from snrmjax.report import style
from snrmjax.report.figures.diagnosis import (
    comparison_figure,
    effect_laws_figure,
    misfit_figure,
)
from snrmjax.report.figures.identification import (
    DampingSeries,
    backbone_figure,
    force_velocity_figure,
    modal_damping_figure,
    response_figure,
)
from snrmjax.report.figures.joint_fit import (
    FitSeries,
    contributions_figure,
    fitted_curves_figure,
    next_measurements_figure,
    residuals_figure,
)
from snrmjax.report.figures.modes import (
    decay_figure,
    modal_responses_figure,
    stabilisation_figure,
)
from snrmjax.report.figures.parts import parts_figure
from snrmjax.report.figures.simulation import (
    batch_figure,
    damped_mode_figure,
    event_curve_figure,
    motions_figure,
    normal_mode_figure,
    simulated_response_figure,
)
from snrmjax.report.figures.uncertainty import (
    propagation_figure,
    sensitivity_figure,
)
from snrmjax.report.style import save_figure

__all__ = [
    "DampingSeries",
    "FitSeries",
    "backbone_figure",
    "batch_figure",
    "comparison_figure",
    "contributions_figure",
    "damped_mode_figure",
    "decay_figure",
    "effect_laws_figure",
    "event_curve_figure",
    "fitted_curves_figure",
    "force_velocity_figure",
    "misfit_figure",
    "modal_damping_figure",
    "modal_responses_figure",
    "motions_figure",
    "next_measurements_figure",
    "normal_mode_figure",
    "parts_figure",
    "propagation_figure",
    "residuals_figure",
    "response_figure",
    "save_figure",
    "sensitivity_figure",
    "simulated_response_figure",
    "stabilisation_figure",
    "style",
]
