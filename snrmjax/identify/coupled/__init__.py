"""Modes that exchange energy: which, how strongly, and what it does to the backbone of one mode."""
