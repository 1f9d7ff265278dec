"""Where the misfit lies, and which effects explain it."""
