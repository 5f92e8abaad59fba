"""Information about the base parameters that joint states carry."""
