"""Pages: the report of each result, and the files written with it."""
