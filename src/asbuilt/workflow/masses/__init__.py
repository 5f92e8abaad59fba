"""Masses of links from geometry, materials or a table, compared with the description."""
