from .bench.cbc import (
    FeedbackSettings,
    HeldMotion,
    SCurve,
    TargetFeedback,
    control_based_continuation,
    s_curve,
)
from .bench.laboratory import (
    AbstractController,
    Instruments,
    Laboratory,
    Shaker,
    TestRecord,
    run_test,
)
from .bench.pll import LoopGains, PhaseLockedLoop, phase_locked_loop, standard_gains
from .comparison import METHODS, Comparison, compare_methods, snrm
from .records.resonant_decay import resonant_decay
from .records.restoring_force import RestoringForce, fit_restoring_force, restoring_force
from .result import MethodResult, MethodStatus
from .steady.arslan_ozguven import arslan_ozguven, describing_function
from .steady.concerto import concerto
from .steady.harmonic_force_surface import ForceSurface, force_surface, harmonic_force_surface
from .steady.phase_resonance import phase_resonance
from .steady.rct import rct

__all__ = [
    "METHODS",
    "AbstractController",
    "Comparison",
    "FeedbackSettings",
    "ForceSurface",
    "HeldMotion",
    "Instruments",
    "Laboratory",
    "LoopGains",
    "MethodResult",
    "MethodStatus",
    "PhaseLockedLoop",
    "RestoringForce",
    "SCurve",
    "Shaker",
    "TargetFeedback",
    "TestRecord",
    "arslan_ozguven",
    "compare_methods",
    "concerto",
    "control_based_continuation",
    "describing_function",
    "fit_restoring_force",
    "force_surface",
    "harmonic_force_surface",
    "phase_locked_loop",
    "phase_resonance",
    "rct",
    "resonant_decay",
    "restoring_force",
    "run_test",
    "s_curve",
    "snrm",
    "standard_gains",
]
