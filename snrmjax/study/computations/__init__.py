"""Computations of a study for every member: one class each."""
