# The public names and where they live; `__init__.py` imports each on first use.
from .diagnose.diagnosis import Diagnosis, diagnose_model
from .identify.calibrate.calibration import CalibratedModel, calibrate_model
from .identify.curves.families import FAMILIES
from .identify.inference.fitted_curves import fitted_values
from .identify.inference.fitted_response import FittedPoint, FittedResponse, fitted_response
from .identify.inference.optimal_design import NextMeasurement, next_measurements
from .identify.inference.uncertainty import (
    bootstrap,
    compare_bands,
    contributions,
    profile,
    sample_posterior,
    sensitivity,
)
from .identify.joint.joint_fit import JointFit, fit_jointly
from .identify.pointwise.backbone import Backbone, BackboneFit, fit_backbone
from .identify.pointwise.backbone_points import BackbonePoints, identify_points
from .identify.pointwise.identification import Identification, identify_backbone
from .identify.pointwise.inversion import (
    PointStatus,
    SnrmPoints,
    closed_form,
    invert_amplitude_phase,
    invert_phasor,
)
from .identify.pointwise.prediction import (
    PredictedResponse,
    Resonance,
    predict_response,
    resonance_by_fixed_point,
    resonances,
)
from .identify.pointwise.snrm import nonlinear_mode_velocity, reference_sensor, snrm_velocity
from .measure.indicators import appropriation_of, mode_indicator, nnm_appropriation
from .measure.steady_states import SteadyStates, join_steady_states, steady_states
from .model.averaging import averaged_effect, averaged_force, averaged_response
from .model.beams import curved_beam, flat_beam
from .model.effect_base import AbstractHysteresis, AbstractMemoryless
from .model.effects import make_effect, register_effect
from .model.modes import LinearModes, linear_modes, linear_response
from .model.potential import (
    PolynomialPotential,
    polynomial_potential,
    potential_from_force_table,
)
from .model.structure import Structure, equilibria, structure
from .simulate.balance.harmonics import velocity_phasors
from .simulate.continuation.continuation import CurveStatus, StepControl
from .simulate.continuation.response_curve import ResponseCurve
from .simulate.continuation.stability import StabilityLoss, floquet_multipliers
from .simulate.solutions.controlled import (
    ControlledCurve,
    DampedModeBranch,
    damped_normal_mode,
    phase_controlled,
    response_controlled,
)
from .simulate.solutions.forced_response import (
    ResponseBatch,
    forced_response,
    forced_response_batch,
    solve_at_frequency,
)
from .simulate.solutions.isolated_responses import isolated_responses
from .simulate.solutions.normal_modes import NormalModeBranch, Tongue, nonlinear_normal_mode
from .simulate.solutions.periodic_motion import (
    PeriodicMotion,
    motions_at_velocities,
    periodic_motion,
    response_at_velocities,
)
from .simulate.solutions.time_integration import (
    IntegratedMotion,
    MotionStatus,
    settled_motion,
    stepped_sine,
)
from .simulate.virtual_test.controlled_test import phase_controlled_test, response_controlled_test
from .simulate.virtual_test.phase_resonance_test import (
    MeasurementErrors,
    VirtualTest,
    phase_resonance_test,
)

__all__ = [
    "FAMILIES",
    "AbstractHysteresis",
    "AbstractMemoryless",
    "Backbone",
    "BackboneFit",
    "BackbonePoints",
    "CalibratedModel",
    "ControlledCurve",
    "CurveStatus",
    "DampedModeBranch",
    "Diagnosis",
    "FittedPoint",
    "FittedResponse",
    "Identification",
    "IntegratedMotion",
    "JointFit",
    "LinearModes",
    "MeasurementErrors",
    "MotionStatus",
    "NextMeasurement",
    "NormalModeBranch",
    "PeriodicMotion",
    "PointStatus",
    "PolynomialPotential",
    "PredictedResponse",
    "Resonance",
    "ResponseBatch",
    "ResponseCurve",
    "SnrmPoints",
    "StabilityLoss",
    "SteadyStates",
    "StepControl",
    "Structure",
    "Tongue",
    "VirtualTest",
    "appropriation_of",
    "averaged_effect",
    "averaged_force",
    "averaged_response",
    "bootstrap",
    "calibrate_model",
    "closed_form",
    "compare_bands",
    "contributions",
    "curved_beam",
    "damped_normal_mode",
    "diagnose_model",
    "equilibria",
    "fit_backbone",
    "fit_jointly",
    "fitted_response",
    "fitted_values",
    "flat_beam",
    "floquet_multipliers",
    "forced_response",
    "forced_response_batch",
    "identify_backbone",
    "identify_points",
    "invert_amplitude_phase",
    "invert_phasor",
    "isolated_responses",
    "join_steady_states",
    "linear_modes",
    "linear_response",
    "make_effect",
    "mode_indicator",
    "motions_at_velocities",
    "next_measurements",
    "nnm_appropriation",
    "nonlinear_mode_velocity",
    "nonlinear_normal_mode",
    "periodic_motion",
    "phase_controlled",
    "phase_controlled_test",
    "phase_resonance_test",
    "polynomial_potential",
    "potential_from_force_table",
    "predict_response",
    "profile",
    "reference_sensor",
    "register_effect",
    "resonance_by_fixed_point",
    "resonances",
    "response_at_velocities",
    "response_controlled",
    "response_controlled_test",
    "sample_posterior",
    "sensitivity",
    "settled_motion",
    "snrm_velocity",
    "solve_at_frequency",
    "steady_states",
    "stepped_sine",
    "structure",
    "velocity_phasors",
]
