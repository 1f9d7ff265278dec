"""Figures: one file a kind of result."""
