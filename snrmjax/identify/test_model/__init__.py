"""The statistical model of a test: one posterior of curves, levels, mass and noise."""
