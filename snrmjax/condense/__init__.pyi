from .condensation import reduced_model
from .elements.beam import Beam, PointMass, Support, rise_of_radius
from .elements.beam_modes import beam_modes, participation, shape_at
from .elements.statics import static_cases
from .load_cases import ReductionBasis, StaticCases
from .load_set import displacement_for_ratio, modal_loads
from .potential_fit import fit_potential
from .scale_study import load_scale_study
from .static_response import static_displacement

__all__ = [
    "Beam",
    "PointMass",
    "ReductionBasis",
    "StaticCases",
    "Support",
    "beam_modes",
    "displacement_for_ratio",
    "fit_potential",
    "load_scale_study",
    "modal_loads",
    "participation",
    "reduced_model",
    "rise_of_radius",
    "shape_at",
    "static_cases",
    "static_displacement",
]
