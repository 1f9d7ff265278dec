"""Steady motions: forced responses, normal modes, controlled and quasi-periodic motions."""
