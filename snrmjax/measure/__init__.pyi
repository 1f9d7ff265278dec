from .base_excitation import base_excited_states
from .decays.isolated_decay import IsolatedDecay, isolate_decay
from .recordings.channels import Channel
from .recordings.frequency_responses import FrequencyResponses, frequency_responses
from .recordings.multisine import MultisineResponses, multisine_responses
from .recordings.ring_down import find_ring_downs
from .recordings.stepped_sine import SteppedSineStates, stepped_sine_states
from .recordings.time_recording import TimeRecording, time_recording
from .signals import (
    appropriation_of,
    force_velocity_loop,
    nnm_appropriation,
    peak_amplitude,
    synthesise,
)
from .states import SteadyStates, join_steady_states, steady_states
from .sweeps.slow_sweep import SweptStates, sweep_states
from .sweeps.sweep_bias import sweep_bias

__all__ = [
    "Channel",
    "FrequencyResponses",
    "IsolatedDecay",
    "MultisineResponses",
    "SteadyStates",
    "SteppedSineStates",
    "SweptStates",
    "TimeRecording",
    "appropriation_of",
    "base_excited_states",
    "find_ring_downs",
    "force_velocity_loop",
    "frequency_responses",
    "isolate_decay",
    "join_steady_states",
    "multisine_responses",
    "nnm_appropriation",
    "peak_amplitude",
    "steady_states",
    "stepped_sine_states",
    "sweep_bias",
    "sweep_states",
    "synthesise",
    "time_recording",
]
