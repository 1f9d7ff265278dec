from .balance.harmonics import velocity_phasors
from .continuation.continuation import CurveStatus, StepControl
from .continuation.response_curve import ResponseCurve
from .continuation.stability import Stability, floquet_multipliers
from .solutions.controlled import damped_normal_mode, phase_controlled, response_controlled
from .solutions.event_curves import EventCurve, follow_event
from .solutions.forced_response import (
    ResponseSettings,
    forced_response,
    forced_response_batch,
    solve_at_frequency,
)
from .solutions.isolated_responses import IsolatedSearch, isolated_responses
from .solutions.mode_at_velocities import normal_mode_at_velocities
from .solutions.normal_modes import nonlinear_normal_mode
from .solutions.periodic_motion import periodic_motion
from .solutions.quasi_periodic import quasi_periodic_branch
from .solutions.tracked_motion import TrackedMotion
from .virtual_test.equipment import Instruments, Shaker
from .virtual_test.laboratory import AbstractController, Laboratory, run_test
from .virtual_test.phase_loop import LoopGains, phase_sweep
from .virtual_test.phase_resonance_test import phase_resonance_test
from .virtual_test.programmes import (
    Playback,
    decay_test,
    multisine_test,
    steady_states_of,
    stepped_sine_test,
)
from .virtual_test.recording import MeasurementErrors, Recording
from .virtual_test.target_feedback import FeedbackSettings, s_curve

__all__ = [
    "AbstractController",
    "CurveStatus",
    "EventCurve",
    "FeedbackSettings",
    "Instruments",
    "IsolatedSearch",
    "Laboratory",
    "LoopGains",
    "MeasurementErrors",
    "Playback",
    "Recording",
    "ResponseCurve",
    "ResponseSettings",
    "Shaker",
    "Stability",
    "StepControl",
    "TrackedMotion",
    "damped_normal_mode",
    "decay_test",
    "floquet_multipliers",
    "follow_event",
    "forced_response",
    "forced_response_batch",
    "isolated_responses",
    "multisine_test",
    "nonlinear_normal_mode",
    "normal_mode_at_velocities",
    "periodic_motion",
    "phase_controlled",
    "phase_resonance_test",
    "phase_sweep",
    "quasi_periodic_branch",
    "response_controlled",
    "run_test",
    "s_curve",
    "solve_at_frequency",
    "steady_states_of",
    "stepped_sine_test",
    "velocity_phasors",
]
