"""Counterweight or ideal spring balancer that turns with the joint."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


@drive_term
class Balancer(DriveTerm):
    """Add `Bs sin(q) + Bc cos(q)`.

    If gravity has a fixed direction in the parent link, it is dependent on the first moment of the
    link.
    """

    key = "balancer"
    position = 80
    symbols = ("Bs", "Bc")
    columns = ("sin(q)", "cos(q)")
    formula = "Bs sin(q) + Bc cos(q)"
    revolute_units = ("N m", "N m")
    prismatic_units = ("N", "N")
    by_construction = True
    turns_over = True
