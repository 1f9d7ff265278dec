"""Files: tables of steady states and of results, and models."""
