"""Free decays: one mode separated from interfering modes, hum, offset and noise."""
