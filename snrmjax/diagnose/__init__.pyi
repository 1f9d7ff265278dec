from .diagnosis import diagnose_model
from .diagnosis_result import Diagnosis

__all__ = ["Diagnosis", "diagnose_model"]
