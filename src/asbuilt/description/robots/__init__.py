"""Robots by name: the bundled ones, and those of the package robot_descriptions."""
