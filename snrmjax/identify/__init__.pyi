from .calibrate.backbone_calibration import MeasuredBackbone, calibrate_to_backbone
from .calibrate.calibration import calibrate_model
from .calibrate.inverse_force import inverse_force
from .coupled.coupled_modes import coupled_modes
from .curves.families import FAMILIES, OwnFamily
from .inference.contributions import contributions
from .inference.fitted_curves import fitted_values
from .inference.fitted_response import fitted_response, predicted_resonance
from .inference.identification import Identification, identify_backbone
from .inference.optimal_design import next_measurements
from .inference.refits import FitInputs, bootstrap, influence, refit
from .joint.joint_fit import JointFit, corrected_states, fit_jointly
from .modal.free_decay import fit_free_decay
from .modal.linear_fit import fit_linear_modes
from .modal.modes_of_tests import find_modes, relative_to_base
from .modal.response_data import joined_responses
from .pointwise.backbone import Backbone
from .pointwise.backbone_points import identify_points
from .pointwise.inversion import PointStatus, closed_form, invert_amplitude_phase, invert_phasor
from .pointwise.prediction import predict_response, resonances
from .pointwise.snrm import nonlinear_mode_velocity, reference_sensor, snrm_velocity
from .prediction.new_level import WITHOUT_LEVEL_ERRORS, DayToDay, new_level
from .scaling.scale import (
    AddedMassTest,
    Calibration,
    DrivePoint,
    Free,
    KnownShape,
    SensorMasses,
    scale_modes,
)

__all__ = [
    "FAMILIES",
    "WITHOUT_LEVEL_ERRORS",
    "AddedMassTest",
    "Backbone",
    "Calibration",
    "DayToDay",
    "DrivePoint",
    "FitInputs",
    "Free",
    "Identification",
    "JointFit",
    "KnownShape",
    "MeasuredBackbone",
    "OwnFamily",
    "PointStatus",
    "SensorMasses",
    "bootstrap",
    "calibrate_model",
    "calibrate_to_backbone",
    "closed_form",
    "contributions",
    "corrected_states",
    "coupled_modes",
    "find_modes",
    "fit_free_decay",
    "fit_jointly",
    "fit_linear_modes",
    "fitted_response",
    "fitted_values",
    "identify_backbone",
    "identify_points",
    "influence",
    "inverse_force",
    "invert_amplitude_phase",
    "invert_phasor",
    "joined_responses",
    "new_level",
    "next_measurements",
    "nonlinear_mode_velocity",
    "predict_response",
    "predicted_resonance",
    "reference_sensor",
    "refit",
    "relative_to_base",
    "resonances",
    "scale_modes",
    "snrm_velocity",
]
