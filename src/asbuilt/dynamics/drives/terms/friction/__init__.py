"""Friction by the velocity of the joint alone."""
