"""Payload, torque gains, mounting and two torque channels."""
