"""Virtual tests: the states that a test visits, and the records of its instruments."""
