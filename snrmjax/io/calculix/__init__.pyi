from .deck import Deck, read_deck
from .modes import LinearModes, linear_modes
from .static import StaticRun, static_cases

__all__ = [
    "Deck",
    "LinearModes",
    "StaticRun",
    "linear_modes",
    "read_deck",
    "static_cases",
]
