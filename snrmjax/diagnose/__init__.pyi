from .decide import Verdict
from .design.discriminating_test import DiscriminatingTest
from .diagnosis import diagnose_model
from .diagnosis_result import Answer, CompletedStatus, Diagnosis, Estimate
from .response_prediction import LevelPredictions, LevelResponse, predict_levels

__all__ = [
    "Answer",
    "CompletedStatus",
    "Diagnosis",
    "DiscriminatingTest",
    "Estimate",
    "LevelPredictions",
    "LevelResponse",
    "Verdict",
    "diagnose_model",
    "predict_levels",
]
