"""Figures of uncertainty and sensitivity."""
