from .base_excitation import base_excited_states
from .equivalent_force import EquivalentForce, ForceStatus, equivalent_force
from .force_calibration import ForceCalibration, apply_calibration, calibrate_force
from .harmonic_fit import HarmonicFit, HarmonicFitStatus, fit_harmonics, phasor_relative_to_force
from .indicators import appropriation_of, mode_indicator, nnm_appropriation
from .recordings.channels import Channel
from .recordings.frequency_responses import FrequencyResponses, frequency_responses
from .recordings.multisine import MultisineResponses, multisine_responses
from .recordings.ring_down import RingDown, find_ring_downs
from .recordings.stepped_sine import SteppedSineStates, StepStatus, stepped_sine_states
from .recordings.time_recording import TimeRecording, time_recording
from .records import steady_state_from_records
from .signals import ForceVelocityLoop, force_velocity_loop, peak_amplitude, synthesise
from .states import OptionalColumns, SteadyStates, join_steady_states, steady_states
from .sweeps.slow_sweep import SweepStatus, SweptStates, sweep_states
from .sweeps.sweep_bias import SweepBias, sweep_bias

__all__ = [
    "Channel",
    "EquivalentForce",
    "ForceCalibration",
    "ForceStatus",
    "ForceVelocityLoop",
    "FrequencyResponses",
    "HarmonicFit",
    "HarmonicFitStatus",
    "MultisineResponses",
    "OptionalColumns",
    "RingDown",
    "SteadyStates",
    "StepStatus",
    "SteppedSineStates",
    "SweepBias",
    "SweepStatus",
    "SweptStates",
    "TimeRecording",
    "apply_calibration",
    "appropriation_of",
    "base_excited_states",
    "calibrate_force",
    "equivalent_force",
    "find_ring_downs",
    "fit_harmonics",
    "force_velocity_loop",
    "frequency_responses",
    "join_steady_states",
    "mode_indicator",
    "multisine_responses",
    "nnm_appropriation",
    "peak_amplitude",
    "phasor_relative_to_force",
    "steady_state_from_records",
    "steady_states",
    "stepped_sine_states",
    "sweep_bias",
    "sweep_states",
    "synthesise",
    "time_recording",
]
