"""Changes of the robots of a fleet: which, when, what and how large."""
