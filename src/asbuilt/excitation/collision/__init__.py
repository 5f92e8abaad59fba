"""Distances between the bodies of a robot and to obstacles, and their constraints."""
