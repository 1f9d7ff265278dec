"""Whether what a fit leaves is noise."""
