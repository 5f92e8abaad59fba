"""Friction of constant size against the motion."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, drive_term


@drive_term
class Coulomb(DriveTerm):
    """Add `Fc sign(qd)`, exactly 0 at standstill."""

    key = "coulomb"
    title = "Coulomb friction"
    position = 30
    symbols = ("Fc",)
    columns = ("sign(qd)",)
    formula = "Fc sign(qd)"
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    cause = "friction"
    non_negative = True
    default_for = ALL_SOURCES
