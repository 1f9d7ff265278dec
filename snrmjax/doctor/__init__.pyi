from .check import check_test
from .findings import Checkup

__all__ = ["Checkup", "check_test"]
