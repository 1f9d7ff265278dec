"""Evaluation of a study's data set: outputs, distributions, effects, bands, failures."""
