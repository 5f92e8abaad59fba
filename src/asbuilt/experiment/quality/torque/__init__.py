"""Checks of the torque columns: signal, sign, scale and order."""
