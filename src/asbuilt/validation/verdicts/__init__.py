"""Verdicts: whether to use an identified model, and why."""
