"""Checks of an answer: residual noise, cross-validation on levels, gains."""
