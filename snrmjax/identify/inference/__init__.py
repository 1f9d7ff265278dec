"""What a joint fit says: curves and responses with bands, and what to measure next."""
