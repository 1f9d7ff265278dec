from .bench.cbc import (
    FeedbackSettings,
    FundamentalFeedback,
    HeldMotion,
    SCurve,
    TargetFeedback,
    control_based_continuation,
    s_curve,
)
from .bench.equipment import Instruments, Shaker
from .bench.laboratory import AbstractController, Laboratory, TestRecord, detached, run_test
from .bench.pll import (
    LoopGains,
    PhaseLockedLoop,
    PhaseSweep,
    phase_locked_loop,
    phase_sweep,
    standard_gains,
)
from .bench.programmes import (
    AmplitudeGains,
    DecayTest,
    LaboratoryTest,
    Playback,
    SteppedSineDrive,
    TestSteps,
    decay_test,
    multisine_test,
    standard_amplitude_gains,
    steady_states_of,
    stepped_sine_test,
)
from .comparison import METHODS, Comparison, compare_methods, snrm
from .record_comparison import RECORD_METHODS
from .records.pnlss import pnlss
from .records.recorded_test import RecordedTest, RecordKind, recorded_test
from .records.resonant_decay import resonant_decay
from .records.restoring_force import RestoringForce, fit_restoring_force, restoring_force
from .records.ring_down_decays import ring_down_decays
from .records.ssm import SpectralSubmanifold, fit_submanifold, ssm
from .records.state_space_fit import StateSpaceFit, fit_state_space
from .result import MethodResult, MethodStatus
from .steady.arslan_ozguven import arslan_ozguven, describing_function
from .steady.concerto import concerto
from .steady.harmonic_force_surface import ForceSurface, force_surface, harmonic_force_surface
from .steady.mode_synthesis import backbone_of, synthesised_response
from .steady.phase_resonance import phase_resonance
from .steady.rct import rct

__all__ = [
    "METHODS",
    "RECORD_METHODS",
    "AbstractController",
    "AmplitudeGains",
    "Comparison",
    "DecayTest",
    "FeedbackSettings",
    "ForceSurface",
    "FundamentalFeedback",
    "HeldMotion",
    "Instruments",
    "Laboratory",
    "LaboratoryTest",
    "LoopGains",
    "MethodResult",
    "MethodStatus",
    "PhaseLockedLoop",
    "PhaseSweep",
    "Playback",
    "RecordKind",
    "RecordedTest",
    "RestoringForce",
    "SCurve",
    "Shaker",
    "SpectralSubmanifold",
    "StateSpaceFit",
    "SteppedSineDrive",
    "TargetFeedback",
    "TestRecord",
    "TestSteps",
    "arslan_ozguven",
    "backbone_of",
    "compare_methods",
    "concerto",
    "control_based_continuation",
    "decay_test",
    "describing_function",
    "detached",
    "fit_restoring_force",
    "fit_state_space",
    "fit_submanifold",
    "force_surface",
    "harmonic_force_surface",
    "multisine_test",
    "phase_locked_loop",
    "phase_resonance",
    "phase_sweep",
    "pnlss",
    "rct",
    "recorded_test",
    "resonant_decay",
    "restoring_force",
    "ring_down_decays",
    "run_test",
    "s_curve",
    "snrm",
    "ssm",
    "standard_amplitude_gains",
    "standard_gains",
    "steady_states_of",
    "stepped_sine_test",
    "synthesised_response",
]
