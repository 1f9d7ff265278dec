from .arslan_ozguven import arslan_ozguven, describing_function
from .comparison import METHODS, Comparison, compare_methods, snrm
from .concerto import concerto
from .harmonic_force_surface import ForceSurface, force_surface, harmonic_force_surface
from .phase_resonance import phase_resonance
from .rct import rct
from .resonant_decay import resonant_decay
from .result import MethodResult, MethodStatus

__all__ = [
    "METHODS",
    "Comparison",
    "ForceSurface",
    "MethodResult",
    "MethodStatus",
    "arslan_ozguven",
    "compare_methods",
    "concerto",
    "describing_function",
    "force_surface",
    "harmonic_force_surface",
    "phase_resonance",
    "rct",
    "resonant_decay",
    "snrm",
]
