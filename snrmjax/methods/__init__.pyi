from .comparison import METHODS, compare_methods, snrm
from .records.pnlss import pnlss
from .records.recorded_decays import restoring_force_of_mode, ssm_of_mode
from .records.resonant_decay import decay_of_mode, resonant_decay
from .records.restoring_force import fit_restoring_force, restoring_force
from .records.ssm import ssm
from .records.state_space_fit import fit_state_space
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
    "decay_of_mode",
    "fit_restoring_force",
    "fit_state_space",
    "force_surface",
    "harmonic_force_surface",
    "phase_locked_loop",
    "phase_resonance",
    "pnlss",
    "rct",
    "resonant_decay",
    "restoring_force",
    "restoring_force_of_mode",
    "snrm",
    "ssm",
    "ssm_of_mode",
]
