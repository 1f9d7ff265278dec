"""Laws that a diagnosis draws, as figures and tables."""
