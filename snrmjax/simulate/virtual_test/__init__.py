"""Virtual tests: which states a test visits, and what its instruments record of them."""
