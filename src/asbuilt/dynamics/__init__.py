"""What is true before any measurement.

Equations of motion, their regressor, drives and base parameters.
"""
