"""Structures ready made: beams and arches with known numbers, and from matrices."""
