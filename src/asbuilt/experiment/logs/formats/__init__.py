"""Log formats, one file per format."""
