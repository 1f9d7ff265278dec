"""Methods for tables of steady states."""
