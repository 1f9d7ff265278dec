"""Pages: what a report of each result tells, and the files beside it."""
