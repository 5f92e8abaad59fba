"""One file per format that recordings come in."""
