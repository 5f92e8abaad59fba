"""Recordings with what a model makes of them, for viewers of time series."""
