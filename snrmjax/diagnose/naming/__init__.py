"""Which laws explain most of what a test shows beyond its model, how much, and what is left."""
