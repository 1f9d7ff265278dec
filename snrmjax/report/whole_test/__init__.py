"""A folder of a test from its files to one report."""
