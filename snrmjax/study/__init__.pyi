from .computations.modes import DampedModes, NormalModes
from .computations.responses import Curves, Peaks, ResponseRange
from .computations.tests import Diagnoses, Identifications, VirtualTests
from .run import RunSettings, Shard, StudyRun, discard_chunks, open_study, run_study
from .sampling import Sampling
from .study import Study
from .study_file import read_study
from .variations import joint_normal, listed, lognormal, normal, ranged, uniform

__all__ = [
    "Curves",
    "DampedModes",
    "Diagnoses",
    "Identifications",
    "NormalModes",
    "Peaks",
    "ResponseRange",
    "RunSettings",
    "Sampling",
    "Shard",
    "Study",
    "StudyRun",
    "VirtualTests",
    "discard_chunks",
    "joint_normal",
    "listed",
    "lognormal",
    "normal",
    "open_study",
    "ranged",
    "read_study",
    "run_study",
    "uniform",
]
