"""Simulated motion compared with measured motion, and parameters that fit it better."""
