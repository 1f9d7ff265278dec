from .computations.modes import DampedModes, NormalModes
from .computations.responses import Curves, Peaks, ResponseRange
from .computations.tests import Diagnoses, Identifications, VirtualTests
from .run import open_study, run_study
from .sampling import Sampling
from .study import Study
from .study_file import read_study
from .uncertainty.propagation import propagate_uncertainty
from .uncertainty.quantities import function_quantities, response_quantities
from .uncertainty.sensitivity import sobol_indices
from .variations import (
    Discrete,
    LogNormal,
    MultivariateNormal,
    Normal,
    Uniform,
)

__all__ = [
    "Curves",
    "DampedModes",
    "Diagnoses",
    "Discrete",
    "Identifications",
    "LogNormal",
    "MultivariateNormal",
    "Normal",
    "NormalModes",
    "Peaks",
    "ResponseRange",
    "Sampling",
    "Study",
    "Uniform",
    "VirtualTests",
    "function_quantities",
    "open_study",
    "propagate_uncertainty",
    "read_study",
    "response_quantities",
    "run_study",
    "sobol_indices",
]
