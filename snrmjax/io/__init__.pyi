from . import calculix
from .joint_results import read_joint_fit, write_fitted_backbone, write_joint_fit, write_next
from .models import read_model, write_model
from .reduction.beam_models import BeamModels, read_beam_models
from .reduction.beam_source import read_beam
from .reduction.load_tables import read_load_tables
from .reduction.source import write_load_cases
from .results import (
    write_backbone,
    write_normal_mode,
    write_points,
    write_prediction,
    write_response,
)
from .tables import read_steady_states, write_steady_states, write_table

__all__ = [
    "BeamModels",
    "calculix",
    "read_beam",
    "read_beam_models",
    "read_joint_fit",
    "read_load_tables",
    "read_model",
    "read_steady_states",
    "write_backbone",
    "write_fitted_backbone",
    "write_joint_fit",
    "write_load_cases",
    "write_model",
    "write_next",
    "write_normal_mode",
    "write_points",
    "write_prediction",
    "write_response",
    "write_steady_states",
    "write_table",
]
