"""Robot descriptions, one file per format."""
