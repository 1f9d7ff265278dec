from .case_checks import CaseWarning
from .condensation import Condensation, FitQuality, condense
from .expansion import MembraneExpansion, fit_expansion
from .load_cases import ReductionBasis, StaticCases
from .load_set import LoadSet, displacement_for_ratio, modal_loads
from .potential_fit import fit_potential
from .scale_study import LoadScaleStudy, load_scale_study
from .static_response import static_displacement

__all__ = [
    "CaseWarning",
    "Condensation",
    "FitQuality",
    "LoadScaleStudy",
    "LoadSet",
    "MembraneExpansion",
    "ReductionBasis",
    "StaticCases",
    "condense",
    "displacement_for_ratio",
    "fit_expansion",
    "fit_potential",
    "load_scale_study",
    "modal_loads",
    "static_displacement",
]
