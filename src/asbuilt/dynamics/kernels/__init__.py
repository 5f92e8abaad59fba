"""Compiled functions that evaluate the dynamics for blocks of samples."""
