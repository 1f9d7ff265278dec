"""What reduced models are condensed from: beams as TOML, and folders of load-case tables."""
