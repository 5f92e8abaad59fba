"""Simulated motion beside measured motion, and what fits it better."""
