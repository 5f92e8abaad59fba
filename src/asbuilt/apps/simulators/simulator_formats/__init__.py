"""One module for each format, which registers itself."""
