"""Causes that explain the torque error of CAD."""
