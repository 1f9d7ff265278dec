from .decide import Verdict
from .diagnosis import diagnose_model
from .diagnosis_result import Diagnosis
from .response_prediction import predict_levels

__all__ = ["Diagnosis", "Verdict", "diagnose_model", "predict_levels"]
