"""MCAP files: records, and the messages that are joint states or JSON."""
