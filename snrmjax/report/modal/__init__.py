"""Figures and report of linear modes."""
