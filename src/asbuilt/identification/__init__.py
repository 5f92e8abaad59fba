"""Find the base parameters from samples, with their errors and their verdict."""
