from .calibrate.calibration import CalibratedModel, calibrate_model
from .calibrate.inverse_force import InverseForce, inverse_force
from .curves.families import FAMILIES
from .inference.fitted_curves import fitted_values
from .inference.fitted_response import FittedPoint, FittedResponse, fitted_response
from .inference.optimal_design import (
    AdviceStatus,
    NextMeasurement,
    NextMeasurements,
    next_measurements,
)
from .inference.profiles import profile
from .inference.resampling import bootstrap, compare_bands, sample_posterior
from .inference.sensitivity import contributions, sensitivity
from .joint.joint_fit import JointFit, fit_jointly
from .pointwise.backbone import Backbone, BackboneFit, BackboneValues, fit_backbone
from .pointwise.backbone_points import identify_points
from .pointwise.identification import Identification, identify_backbone
from .pointwise.inversion import closed_form, invert_amplitude_phase, invert_phasor
from .pointwise.inversion_result import PointStatus, SnrmPoints
from .pointwise.points_result import BackbonePoints
from .pointwise.prediction import predict_response, resonance_by_fixed_point, resonances
from .pointwise.prediction_result import PredictedResponse, Resonance
from .pointwise.snrm import nonlinear_mode_velocity, reference_sensor, snrm_velocity

__all__ = [
    "FAMILIES",
    "AdviceStatus",
    "Backbone",
    "BackboneFit",
    "BackbonePoints",
    "BackboneValues",
    "CalibratedModel",
    "FittedPoint",
    "FittedResponse",
    "Identification",
    "InverseForce",
    "JointFit",
    "NextMeasurement",
    "NextMeasurements",
    "PointStatus",
    "PredictedResponse",
    "Resonance",
    "SnrmPoints",
    "bootstrap",
    "calibrate_model",
    "closed_form",
    "compare_bands",
    "contributions",
    "fit_backbone",
    "fit_jointly",
    "fitted_response",
    "fitted_values",
    "identify_backbone",
    "identify_points",
    "inverse_force",
    "invert_amplitude_phase",
    "invert_phasor",
    "next_measurements",
    "nonlinear_mode_velocity",
    "predict_response",
    "profile",
    "reference_sensor",
    "resonance_by_fixed_point",
    "resonances",
    "sample_posterior",
    "sensitivity",
    "snrm_velocity",
]
