"""Design of motions by optimisation."""
