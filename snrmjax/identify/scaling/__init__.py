"""Mass-normalised shapes from the residues of linear modes."""
