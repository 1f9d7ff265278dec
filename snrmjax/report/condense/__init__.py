"""Reports of reduced-order models."""
