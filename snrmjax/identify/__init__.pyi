from .calibrate.backbone_calibration import (
    BackboneCalibration,
    MeasuredBackbone,
    calibrate_to_backbone,
)
from .calibrate.calibrated_model import CalibratedModel
from .calibrate.calibration import calibrate_model
from .calibrate.inverse_force import InverseForce, inverse_force
from .curves.families import FAMILIES
from .inference.contributions import Contribution, Contributions, contributions
from .inference.fitted_curves import fitted_values
from .inference.fitted_response import FittedResponse, fitted_response, predicted_resonance
from .inference.identification import Identification, identify_backbone
from .inference.located_points import FittedPoint
from .inference.optimal_design import (
    AdviceStatus,
    NextMeasurement,
    NextMeasurements,
    next_measurements,
)
from .inference.refits import bootstrap
from .joint.family_fit import FitStatus
from .joint.joint_fit import JointFit, corrected_states, fit_jointly
from .joint.notes import NoiseEstimate
from .modal.base_motion import BaseResponses, relative_to_base
from .modal.free_decay import DecayModes, fit_free_decay
from .modal.linear_fit import fit_linear_modes
from .modal.modal_fit import LinearModalFit
from .modal.modes_of_tests import find_modes
from .modal.response_data import joined_responses
from .modal.state_responses import (
    StateResponses,
    amplitude_dependence,
    levels_by_velocity,
    responses_of_states,
)
from .pointwise.backbone import Backbone, BackboneValues
from .pointwise.backbone_points import identify_points
from .pointwise.inversion import closed_form, invert_amplitude_phase, invert_phasor
from .pointwise.inversion_result import PointStatus, SnrmPoints
from .pointwise.points_result import BackbonePoints
from .pointwise.prediction import predict_response, resonances
from .pointwise.prediction_result import PredictedResponse, Resonance
from .pointwise.snrm import nonlinear_mode_velocity, reference_sensor, snrm_velocity
from .prediction.new_level import ON_THE_CURVES, DayToDay, LevelTrend, NewLevel, new_level
from .prediction.resonance_distribution import ResonanceDistribution
from .scaling.scale import (
    AddedMassTest,
    Calibration,
    DrivePoint,
    Free,
    KnownShape,
    SensorMasses,
    scale_modes,
)
from .scaling.scaled_modes import ScaledModes

__all__ = [
    "FAMILIES",
    "ON_THE_CURVES",
    "AddedMassTest",
    "AdviceStatus",
    "Backbone",
    "BackboneCalibration",
    "BackbonePoints",
    "BackboneValues",
    "BaseResponses",
    "CalibratedModel",
    "Calibration",
    "Contribution",
    "Contributions",
    "DayToDay",
    "DecayModes",
    "DrivePoint",
    "FitStatus",
    "FittedPoint",
    "FittedResponse",
    "Free",
    "Identification",
    "InverseForce",
    "JointFit",
    "KnownShape",
    "LevelTrend",
    "LinearModalFit",
    "MeasuredBackbone",
    "NewLevel",
    "NextMeasurement",
    "NextMeasurements",
    "NoiseEstimate",
    "PointStatus",
    "PredictedResponse",
    "Resonance",
    "ResonanceDistribution",
    "ScaledModes",
    "SensorMasses",
    "SnrmPoints",
    "StateResponses",
    "amplitude_dependence",
    "bootstrap",
    "calibrate_model",
    "calibrate_to_backbone",
    "closed_form",
    "contributions",
    "corrected_states",
    "find_modes",
    "fit_free_decay",
    "fit_jointly",
    "fit_linear_modes",
    "fitted_response",
    "fitted_values",
    "identify_backbone",
    "identify_points",
    "inverse_force",
    "invert_amplitude_phase",
    "invert_phasor",
    "joined_responses",
    "levels_by_velocity",
    "new_level",
    "next_measurements",
    "nonlinear_mode_velocity",
    "predict_response",
    "predicted_resonance",
    "reference_sensor",
    "relative_to_base",
    "resonances",
    "responses_of_states",
    "scale_modes",
    "snrm_velocity",
]
