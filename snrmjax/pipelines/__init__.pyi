from .check import check_files
from .diagnose import diagnose_test, read_test
from .identify import identify_test
from .imports import import_test, list_contents
from .measured_files import read_measured_test
from .modes import find_linear_modes, read_modal_sources
from .reduce import read_reduction_source, reduce_model
from .simulate import simulate_mode, simulate_responses
from .whole_test import run_whole_test

__all__ = [
    "check_files",
    "diagnose_test",
    "find_linear_modes",
    "identify_test",
    "import_test",
    "list_contents",
    "read_measured_test",
    "read_modal_sources",
    "read_reduction_source",
    "read_test",
    "reduce_model",
    "run_whole_test",
    "simulate_mode",
    "simulate_responses",
]
