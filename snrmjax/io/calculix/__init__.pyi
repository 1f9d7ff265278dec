from .deck import read_deck
from .modes import modes_of_deck, survey_modes
from .reduction import read_deck_source
from .static import run_static_cases

__all__ = ["modes_of_deck", "read_deck", "read_deck_source", "run_static_cases", "survey_modes"]
