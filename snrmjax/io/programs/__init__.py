"""Programs on disk: compiled ones that are kept, and Python files with a user's own effects."""
