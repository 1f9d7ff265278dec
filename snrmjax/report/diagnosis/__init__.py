"""Parts of the report of a diagnosis."""
