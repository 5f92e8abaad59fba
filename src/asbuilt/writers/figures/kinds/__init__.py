"""Figures that results draw by name; each module registers one."""
