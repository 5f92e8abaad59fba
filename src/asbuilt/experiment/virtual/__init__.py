"""Virtual robots to record."""
