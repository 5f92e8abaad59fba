"""Noise of logged positions: step of the values, and what it leaves of the band."""
