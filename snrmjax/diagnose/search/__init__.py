"""Which part of the force balance disagrees, and which effects explain it."""
