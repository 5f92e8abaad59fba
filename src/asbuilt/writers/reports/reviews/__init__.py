"""Review of a robot description in words, tables and plain data."""
