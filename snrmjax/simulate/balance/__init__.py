"""Harmonic balance: Fourier series, residuals with exact Jacobians, prescribed motion."""
