"""Masses of links from geometry, materials or a table, beside those of the description."""
