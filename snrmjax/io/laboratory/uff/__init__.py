"""Universal files (UFF/UNV): functions 58 and 58b, units 164."""
