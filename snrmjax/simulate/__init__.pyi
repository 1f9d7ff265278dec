from .balance.harmonics import velocity_phasors
from .continuation.continuation import CurveStatus, StepControl
from .continuation.response_curve import ResponseCurve
from .continuation.stability import Stability, StabilityLoss, floquet_multipliers
from .solutions.controlled import (
    ControlledCurve,
    DampedModeBranch,
    damped_normal_mode,
    phase_controlled,
    response_controlled,
)
from .solutions.forced_response import (
    ResponseBatch,
    ResponseSettings,
    forced_response,
    forced_response_batch,
    solve_at_frequency,
)
from .solutions.isolated_responses import IsolatedResponses, IsolatedSearch, isolated_responses
from .solutions.mode_at_velocities import normal_mode_at_velocities
from .solutions.normal_modes import NormalModeBranch, Tongue, nonlinear_normal_mode
from .solutions.periodic_motion import (
    PeriodicMotion,
    motions_at_velocities,
    periodic_motion,
    response_at_velocities,
)
from .solutions.time_integration import (
    IntegratedMotion,
    IntegrationAccuracy,
    MotionStatus,
    settled_motion,
    stepped_sine,
)
from .virtual_test.controlled_test import phase_controlled_test, response_controlled_test
from .virtual_test.phase_resonance_test import SweepSimulation, VirtualTest, phase_resonance_test
from .virtual_test.recording import MeasurementErrors, Recording

__all__ = [
    "ControlledCurve",
    "CurveStatus",
    "DampedModeBranch",
    "IntegratedMotion",
    "IntegrationAccuracy",
    "IsolatedResponses",
    "IsolatedSearch",
    "MeasurementErrors",
    "MotionStatus",
    "NormalModeBranch",
    "PeriodicMotion",
    "Recording",
    "ResponseBatch",
    "ResponseCurve",
    "ResponseSettings",
    "Stability",
    "StabilityLoss",
    "StepControl",
    "SweepSimulation",
    "Tongue",
    "VirtualTest",
    "damped_normal_mode",
    "floquet_multipliers",
    "forced_response",
    "forced_response_batch",
    "isolated_responses",
    "motions_at_velocities",
    "nonlinear_normal_mode",
    "normal_mode_at_velocities",
    "periodic_motion",
    "phase_controlled",
    "phase_controlled_test",
    "phase_resonance_test",
    "response_at_velocities",
    "response_controlled",
    "response_controlled_test",
    "settled_motion",
    "solve_at_frequency",
    "stepped_sine",
    "velocity_phasors",
]
