"""Slow sweeps: phasors, the bias of a resonance by the sweep, and its correction."""
