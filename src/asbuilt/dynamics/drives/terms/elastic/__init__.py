"""Torque by the position of the joint alone, from springs and cables."""
