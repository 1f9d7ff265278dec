"""Parameters of a model fitted to measured states through its harmonic balance."""
