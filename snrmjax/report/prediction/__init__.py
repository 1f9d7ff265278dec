"""What a test's curves predict under other forces, as commands tell it."""
