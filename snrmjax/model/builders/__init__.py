"""Structures built from matrices, and published beams and arches."""
