"""Methods that run a test by themselves, in a virtual laboratory."""
