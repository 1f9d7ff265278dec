"""Forces (N) of the curved beam's near-resonant test that figures show."""

FORCES = (4.0e-5, 8.0e-5, 1.334e-4)
