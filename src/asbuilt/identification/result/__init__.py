"""The result of an identification, its metrics and its summary."""
