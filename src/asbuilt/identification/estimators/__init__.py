"""Estimators, from square-root information to parameters."""
