from .averaging import averaged_effect, averaged_force, averaged_response
from .beams import curved_beam, flat_beam
from .effect_base import (
    AbstractForce,
    AbstractHysteresis,
    AbstractKinked,
    AbstractLinearChange,
    AbstractMeasurementEffect,
    AbstractMemoryless,
)
from .effect_metadata import (
    Argument,
    Confusion,
    Imitation,
    MotionScales,
    Parameter,
    Part,
    Prior,
    Shape,
    Symmetry,
    parameter,
)
from .effect_shape import shape_of
from .effects import EFFECTS, make_effect, register_effect
from .modes import LinearModes, LinearModesStd, RigidBodyModes, linear_modes, linear_response
from .potential import PolynomialPotential, polynomial_potential, potential_from_force_table
from .structures import Structure, equilibria, structure

__all__ = [
    "EFFECTS",
    "AbstractForce",
    "AbstractHysteresis",
    "AbstractKinked",
    "AbstractLinearChange",
    "AbstractMeasurementEffect",
    "AbstractMemoryless",
    "Argument",
    "Confusion",
    "Imitation",
    "LinearModes",
    "LinearModesStd",
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
    "averaged_force",
    "averaged_response",
    "curved_beam",
    "equilibria",
    "flat_beam",
    "linear_modes",
    "linear_response",
    "make_effect",
    "parameter",
    "polynomial_potential",
    "potential_from_force_table",
    "register_effect",
    "shape_of",
    "structure",
]
