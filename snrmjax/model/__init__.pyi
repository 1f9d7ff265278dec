from .attachment import between
from .builders.beams import CURVED_BEAM_FORCES, FLAT_BEAM_FORCES, curved_beam, flat_beam
from .builders.matrices import Matrices, beam, chain, from_matrices
from .effect_base import (
    AbstractForce,
    AbstractHysteresis,
    AbstractLinearChange,
    AbstractMeasurementEffect,
    AbstractMemoryless,
    AbstractNonsmooth,
)
from .effect_metadata import (
    Argument,
    MotionScales,
    Parameter,
    Part,
    Prior,
    Shape,
    Symmetry,
    parameter,
)
from .effect_shape import averaged_effect, shape_of
from .effects import EFFECTS, ELEMENTS, LAWS, make_effect, register_effect
from .modes import (
    LinearModes,
    LinearModesStd,
    RigidBodyModes,
    linear_modes,
    linear_response,
    residual_velocity,
)
from .moving_base import BaseMotion, base_motion
from .parameters import parameter_names, parameter_values, with_parameters
from .potential import PolynomialPotential, polynomial_potential
from .structures import Structure, equilibria, structure

__all__ = [
    "CURVED_BEAM_FORCES",
    "EFFECTS",
    "ELEMENTS",
    "FLAT_BEAM_FORCES",
    "LAWS",
    "AbstractForce",
    "AbstractHysteresis",
    "AbstractLinearChange",
    "AbstractMeasurementEffect",
    "AbstractMemoryless",
    "AbstractNonsmooth",
    "Argument",
    "BaseMotion",
    "LinearModes",
    "LinearModesStd",
    "Matrices",
    "MotionScales",
    "Parameter",
    "Part",
    "PolynomialPotential",
    "Prior",
    "RigidBodyModes",
    "Shape",
    "Structure",
    "Symmetry",
    "averaged_effect",
    "base_motion",
    "beam",
    "between",
    "chain",
    "curved_beam",
    "equilibria",
    "flat_beam",
    "from_matrices",
    "linear_modes",
    "linear_response",
    "make_effect",
    "parameter",
    "parameter_names",
    "parameter_values",
    "polynomial_potential",
    "register_effect",
    "residual_velocity",
    "shape_of",
    "structure",
    "with_parameters",
]
