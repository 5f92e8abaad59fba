"""Studies by simulated motion."""
