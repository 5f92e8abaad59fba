"""Draws of a robot from the uncertainty of a result."""
