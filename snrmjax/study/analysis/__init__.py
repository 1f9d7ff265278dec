"""What a study's data set says: outputs, their distributions and effects, bands, failures."""
