"""Controller program formats, one per file."""
