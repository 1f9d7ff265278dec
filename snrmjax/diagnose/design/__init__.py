"""Which further test would settle what is open."""
