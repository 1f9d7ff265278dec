from .comparison import METHODS, compare_methods, snrm
from .records.pnlss import pnlss
from .records.resonant_decay import resonant_decay
from .records.restoring_force import restoring_force
from .records.ssm import ssm
from .result import MethodStatus
from .steady.arslan_ozguven import arslan_ozguven
from .steady.concerto import concerto
from .steady.controlled_resonances import control_based_continuation, phase_locked_loop
from .steady.harmonic_force_surface import force_surface, harmonic_force_surface
from .steady.phase_resonance import phase_resonance
from .steady.rct import rct

__all__ = [
    "METHODS",
    "MethodStatus",
    "arslan_ozguven",
    "compare_methods",
    "concerto",
    "control_based_continuation",
    "force_surface",
    "harmonic_force_surface",
    "phase_locked_loop",
    "phase_resonance",
    "pnlss",
    "rct",
    "resonant_decay",
    "restoring_force",
    "snrm",
    "ssm",
]
