"""Programs on disk: cached compiled programs, and Python files with user-defined effects."""
