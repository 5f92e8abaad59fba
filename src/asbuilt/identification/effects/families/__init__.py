"""Families of effects, one file each."""
