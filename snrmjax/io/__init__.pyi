from .joint_results import read_joint_fit, write_joint_fit
from .models import read_model, write_model
from .tables import read_steady_states, write_steady_states

__all__ = [
    "read_joint_fit",
    "read_model",
    "read_steady_states",
    "write_joint_fit",
    "write_model",
    "write_steady_states",
]
