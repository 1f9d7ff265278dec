"""Predictions for a level that was not measured."""
