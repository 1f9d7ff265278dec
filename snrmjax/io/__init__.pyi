from . import calculix
from .joint_results import read_joint_fit, write_joint_fit
from .models import read_model, write_model
from .reduction.beam_file import read_beam, read_beam_models
from .reduction.load_tables import read_load_tables
from .tables import read_steady_states, write_steady_states, write_table

__all__ = [
    "calculix",
    "read_beam",
    "read_beam_models",
    "read_joint_fit",
    "read_load_tables",
    "read_model",
    "read_steady_states",
    "write_joint_fit",
    "write_model",
    "write_steady_states",
    "write_table",
]
