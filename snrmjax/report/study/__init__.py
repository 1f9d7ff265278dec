"""Reports of studies: distributions, main effects, response bands, where members failed."""
