"""Coulomb friction in proportion to the load of gears and bearings."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm, drive_term


@drive_term
class LoadFriction(DriveTerm):
    """Add `Fl |load| sign(qd)`, with the rigid-body torque of the joint as load.

    Source: Hamon, Gautier and Garrec, IROS 2010: dry friction that depends on load.
    """

    key = "load_friction"
    title = "load-dependent friction"
    position = 60
    symbols = ("Fl",)
    columns = ("abs(load)*sign(qd)",)
    formula = "Fl |load| sign(qd)"
    revolute_units = ("1",)
    prismatic_units = ("1",)
    tried_for = ALL_SOURCES
    non_negative = True
    ratio_powers = (0.0,)
