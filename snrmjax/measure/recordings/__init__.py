"""What a laboratory records: channels, time records and frequency responses."""
