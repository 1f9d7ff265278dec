"""Universal files (UFF/UNV): functions 58 and 58b, shapes 55, units 164, nodes 15."""
