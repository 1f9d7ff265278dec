"""Free decays with company: one mode of a ring-down apart from others, hum, offset and noise."""
