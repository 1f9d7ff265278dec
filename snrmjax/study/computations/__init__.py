"""What a study can compute for every member: one class each."""
