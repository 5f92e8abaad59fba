"""Robot descriptions and code for other software."""
