"""Calibration: payload, torque gains, base tilt and two torque channels."""
