"""Methods that read a time record."""
