from .deck import Deck, read_deck
from .modes import DeckModes, modes_of_deck
from .static import StaticRun, run_static_cases

__all__ = [
    "Deck",
    "DeckModes",
    "StaticRun",
    "modes_of_deck",
    "read_deck",
    "run_static_cases",
]
