"""Results of a joint fit: curves and responses with bands, and the next measurements."""
