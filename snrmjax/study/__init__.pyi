from .computations.base import OfForces
from .computations.modes import DampedModes, NormalModes
from .computations.responses import Curves, Peaks, ResponseRange
from .computations.tests import Diagnoses, Identifications, VirtualTests
from .run import RunSettings, Shard, StudyRun, open_study, run_study
from .sampling import Sampling
from .study import Study, planned
from .study_file import read_study
from .uncertainty.propagation import Propagation, propagate_uncertainty
from .uncertainty.quantities import Quantities, function_quantities, response_quantities
from .uncertainty.sensitivity import SobolIndices, sobol_indices
from .variations import (
    joint_normal,
    listed,
    lognormal,
    normal,
    posterior_variation,
    ranged,
    stated_variations,
    uniform,
)

__all__ = [
    "Curves",
    "DampedModes",
    "Diagnoses",
    "Identifications",
    "NormalModes",
    "OfForces",
    "Peaks",
    "Propagation",
    "Quantities",
    "ResponseRange",
    "RunSettings",
    "Sampling",
    "Shard",
    "SobolIndices",
    "Study",
    "StudyRun",
    "VirtualTests",
    "function_quantities",
    "joint_normal",
    "listed",
    "lognormal",
    "normal",
    "open_study",
    "planned",
    "posterior_variation",
    "propagate_uncertainty",
    "ranged",
    "read_study",
    "response_quantities",
    "run_study",
    "sobol_indices",
    "stated_variations",
    "uniform",
]
