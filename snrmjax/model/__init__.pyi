from .averaging import averaged_effect, averaged_force, averaged_response
from .beams import curved_beam, flat_beam
from .effect_base import AbstractHysteresis, AbstractMemoryless
from .effects import make_effect, register_effect
from .modes import LinearModes, linear_modes, linear_response
from .potential import PolynomialPotential, polynomial_potential, potential_from_force_table
from .structures import Structure, equilibria, structure

__all__ = [
    "AbstractHysteresis",
    "AbstractMemoryless",
    "LinearModes",
    "PolynomialPotential",
    "Structure",
    "averaged_effect",
    "averaged_force",
    "averaged_response",
    "curved_beam",
    "equilibria",
    "flat_beam",
    "linear_modes",
    "linear_response",
    "make_effect",
    "polynomial_potential",
    "potential_from_force_table",
    "register_effect",
    "structure",
]
