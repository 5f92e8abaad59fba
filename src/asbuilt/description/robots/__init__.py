"""Robots by name: bundled ones, and the ones in the package robot_descriptions."""
