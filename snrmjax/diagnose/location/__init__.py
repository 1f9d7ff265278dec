"""Where in a structure a nonlinear force acts."""
