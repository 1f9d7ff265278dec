from .case_checks import CaseWarning
from .condensation import Condensation, FitQuality, condense
from .expansion import MembraneExpansion, fit_expansion
from .load_cases import ReductionBasis, StaticCases
from .load_set import LoadSet, displacement_for_ratio, modal_loads
from .potential_fit import fit_potential

__all__ = [
    "CaseWarning",
    "Condensation",
    "FitQuality",
    "LoadSet",
    "MembraneExpansion",
    "ReductionBasis",
    "StaticCases",
    "condense",
    "displacement_for_ratio",
    "fit_expansion",
    "fit_potential",
    "modal_loads",
]
