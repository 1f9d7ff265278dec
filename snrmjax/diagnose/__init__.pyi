from .diagnosis import Diagnosis, diagnose_model

__all__ = ["Diagnosis", "diagnose_model"]
