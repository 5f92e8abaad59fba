"""Expansion of xacro files of unknown origin."""
