"""Errors of the log itself, such as clock, zero positions and gains, found in the residual."""
