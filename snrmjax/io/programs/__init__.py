"""Compiled programs on disk: the compiler's own store, and whole programs of commands."""
