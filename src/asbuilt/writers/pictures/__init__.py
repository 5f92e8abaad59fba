"""Pictures, animations and the 3-D viewer."""
