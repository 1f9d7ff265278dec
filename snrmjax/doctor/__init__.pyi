from .check import check_test
from .findings import KINDS, Checkup, Finding

__all__ = ["KINDS", "Checkup", "Finding", "check_test"]
