from .computations.base import OfForces
from .computations.modes import DampedModes, NormalModes
from .computations.responses import Curves, Peaks, ResponseRange
from .computations.tests import Diagnoses, Identifications, VirtualTests
from .run import RunSettings, Shard, StudyRun, discard_chunks, open_study, run_study
from .sampling import Sampling
from .study import Study, planned
from .study_file import read_study
from .uncertainty.propagation import Propagation, propagate_uncertainty
from .uncertainty.quantities import Quantities, function_quantities, response_quantities
from .uncertainty.sensitivity import SobolIndices, sobol_indices
from .uncertainty.uncertain_inputs import (
    UncertainInputs,
    correlated_inputs,
    posterior_inputs,
    uncertain_inputs,
)
from .variations import joint_normal, listed, lognormal, normal, ranged, uniform

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
    "UncertainInputs",
    "VirtualTests",
    "correlated_inputs",
    "discard_chunks",
    "function_quantities",
    "joint_normal",
    "listed",
    "lognormal",
    "normal",
    "open_study",
    "planned",
    "posterior_inputs",
    "propagate_uncertainty",
    "ranged",
    "read_study",
    "response_quantities",
    "run_study",
    "sobol_indices",
    "uncertain_inputs",
    "uniform",
]
