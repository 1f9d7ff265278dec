"""Methods that read a table of steady states."""
