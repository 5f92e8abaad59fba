"""Coulomb friction that changes sign over a width of velocity instead of at once."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import (
    ALL_SOURCES,
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


@drive_term
class SmoothCoulomb(DriveTerm):
    """Add `Fct tanh(qd / width)`. It replaces `coulomb`, or is added to it.

    Below the width, bristles bend before surfaces slide, and logged velocities are mostly noise. A
    fit tries widths up to a tenth of the top speed.
    """

    width: NonlinearValue = None

    key = "smooth_coulomb"
    title = "smooth Coulomb friction"
    position = 34
    symbols = ("Fct",)
    columns = ("tanh(qd/width)",)
    formula = "Fct tanh(qd / width)"
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    nonlinear = (
        NonlinearParameter(
            "width", 0.02, 1e-4, 2.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
        ),
    )
    tried_for = ALL_SOURCES
    stands_for = "coulomb"
    non_negative = True
