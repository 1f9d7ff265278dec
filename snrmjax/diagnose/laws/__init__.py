"""Laws drawn from the force balance where no effect of the library explains it."""
