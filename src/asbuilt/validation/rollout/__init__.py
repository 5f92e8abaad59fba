"""Simulated motion against measured motion."""
