"""Whether a result generalises to other motion."""
