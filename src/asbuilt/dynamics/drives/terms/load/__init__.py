"""Friction by the load of gears and bearings."""
