from .case_checks import CaseWarning
from .condensation import Condensation, FitQuality, condense
from .elements.beam import Beam, PointMass, Support, rise_of_radius
from .elements.beam_cases import static_cases
from .elements.beam_modes import base_participation, beam_modes, participation, shape_at
from .elements.statics import StaticSolutions, StaticStatus, static_solutions
from .expansion import MembraneExpansion, fit_expansion
from .load_cases import ReductionBasis, StaticCases
from .load_set import LoadSet, displacement_for_ratio, modal_loads
from .potential_fit import fit_potential
from .scale_study import LoadScaleStudy, load_scale_study
from .static_response import static_displacement

__all__ = [
    "Beam",
    "CaseWarning",
    "Condensation",
    "FitQuality",
    "LoadScaleStudy",
    "LoadSet",
    "MembraneExpansion",
    "PointMass",
    "ReductionBasis",
    "StaticCases",
    "StaticSolutions",
    "StaticStatus",
    "Support",
    "base_participation",
    "beam_modes",
    "condense",
    "displacement_for_ratio",
    "fit_expansion",
    "fit_potential",
    "load_scale_study",
    "modal_loads",
    "participation",
    "rise_of_radius",
    "shape_at",
    "static_cases",
    "static_displacement",
    "static_solutions",
]
