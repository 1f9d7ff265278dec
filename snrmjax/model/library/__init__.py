"""The effects of the library: each a class with its force, its parameters and its rules."""
