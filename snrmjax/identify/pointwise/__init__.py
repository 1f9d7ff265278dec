"""One backbone point from each steady state, and curves through the points."""
