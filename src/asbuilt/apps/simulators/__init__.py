"""Drives and servos of an identified robot for simulators and controllers."""
