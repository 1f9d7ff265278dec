"""Whether the data determine what a fit estimates: notes and refusals."""
