"""Compiled programs, blocks of equal problems over the cores, and least squares."""
