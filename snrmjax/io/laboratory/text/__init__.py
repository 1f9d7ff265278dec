"""Laboratory text files: separated columns, LabVIEW measurement files."""
