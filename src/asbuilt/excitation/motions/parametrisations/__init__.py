"""Families of motions, one per file; each registers itself in `PARAMETRISATIONS`."""
