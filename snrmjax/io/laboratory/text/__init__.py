"""Texts of laboratories: separated columns, LabVIEW measurement files."""
