"""Sources of reduced models: beams as TOML, and folders of load-case tables."""
