"""Figures of what was measured, identified, simulated and diagnosed."""

from snrmjax.report.diagnosis_report import candidates_figure, residual_figure, simulated_figure
from snrmjax.report.figures import (
    DampingSeries,
    backbone_figure,
    force_velocity_figure,
    modal_damping_figure,
    normal_mode_figure,
    response_figure,
    save_figure,
    simulated_response_figure,
)
from snrmjax.report.joint_figures import (
    FitSeries,
    advice_figure,
    contributions_figure,
    fitted_curves_figure,
    residuals_figure,
)

__all__ = [
    "DampingSeries",
    "FitSeries",
    "advice_figure",
    "backbone_figure",
    "candidates_figure",
    "contributions_figure",
    "fitted_curves_figure",
    "force_velocity_figure",
    "modal_damping_figure",
    "normal_mode_figure",
    "residual_figure",
    "residuals_figure",
    "response_figure",
    "save_figure",
    "simulated_figure",
    "simulated_response_figure",
]
