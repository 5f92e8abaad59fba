"""CAD against as built, and results against each other."""
