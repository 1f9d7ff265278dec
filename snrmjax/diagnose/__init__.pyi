from .diagnosis import diagnose_model
from .diagnosis_result import Diagnosis
from .location.where import EVERYWHERE, Localisation, locate_force
from .response_prediction import predict_levels
from .verdict import Verdict

__all__ = [
    "EVERYWHERE",
    "Diagnosis",
    "Localisation",
    "Verdict",
    "diagnose_model",
    "locate_force",
    "predict_levels",
]
