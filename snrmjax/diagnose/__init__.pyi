from .diagnosis import diagnose_model
from .diagnosis_result import Diagnosis
from .kinds.hypothesis import Confounder, Hypothesis
from .kinds.registry import register_hypothesis
from .location.where import Localisation, locate_force
from .response_prediction import predict_levels
from .verdict import Verdict

__all__ = [
    "Confounder",
    "Diagnosis",
    "Hypothesis",
    "Localisation",
    "Verdict",
    "diagnose_model",
    "locate_force",
    "predict_levels",
    "register_hypothesis",
]
