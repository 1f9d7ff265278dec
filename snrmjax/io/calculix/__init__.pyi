from .deck import Deck, read_deck
from .modes import DeckModes, ModeSurvey, modes_of_deck, survey_modes
from .reduction import read_deck_source
from .static import StaticRun, run_static_cases

__all__ = [
    "Deck",
    "DeckModes",
    "ModeSurvey",
    "StaticRun",
    "modes_of_deck",
    "read_deck",
    "read_deck_source",
    "run_static_cases",
    "survey_modes",
]
