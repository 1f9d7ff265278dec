"""Laboratory data: channels, time records and frequency responses."""
