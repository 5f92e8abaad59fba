"""Whole studies: prepare recordings, identify, validate, compare."""
