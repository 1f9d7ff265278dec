"""Slow sweeps: phasors on the way, what the sweep does to a resonance, and its removal."""
