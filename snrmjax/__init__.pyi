# The ten verbs to start with, and the namespaces that hold the rest.
from . import (
    condense,
    diagnose,
    doctor,
    identify,
    io,
    measure,
    methods,
    model,
    pipelines,
    plot,
    simulate,
    study,
)
from .diagnose.diagnosis import diagnose_model
from .identify.calibrate.calibration import calibrate_model
from .identify.inference.identification import identify_backbone
from .identify.inference.optimal_design import next_measurements
from .identify.joint.joint_fit import fit_jointly
from .io.models import read_model
from .io.programs.compilation_cache import use_compilation_cache
from .io.tables import read_steady_states
from .report.writing import write_results
from .simulate.solutions.forced_response import forced_response
from .simulate.solutions.normal_modes import nonlinear_normal_mode
from .simulate.virtual_test.phase_resonance_test import phase_resonance_test

__all__ = [
    "calibrate_model",
    "condense",
    "diagnose",
    "diagnose_model",
    "doctor",
    "fit_jointly",
    "forced_response",
    "identify",
    "identify_backbone",
    "io",
    "measure",
    "methods",
    "model",
    "next_measurements",
    "nonlinear_normal_mode",
    "phase_resonance_test",
    "pipelines",
    "plot",
    "read_model",
    "read_steady_states",
    "simulate",
    "study",
    "use_compilation_cache",
    "write_results",
]

__version__: str
