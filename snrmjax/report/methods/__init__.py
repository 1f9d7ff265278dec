"""Reports of several methods on the same data."""
