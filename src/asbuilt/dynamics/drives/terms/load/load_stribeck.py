"""Friction in proportion to the load near standstill, fading with speed."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, NonlinearValue, drive_term
from asbuilt.dynamics.drives.terms.load.fading import FADING


@drive_term
class LoadStribeck(DriveTerm):
    """Add `Fls |load| exp(-|qd / velocity|^power) sign(qd)`.

    Source: Duclusaud, Passault, Padois and Ly, arXiv 2410.08650, 2024: model M4.
    """

    velocity: NonlinearValue = None
    power: NonlinearValue = None

    key = "load_stribeck"
    title = "load-dependent Stribeck friction"
    position = 62
    symbols = ("Fls",)
    columns = ("abs(load)*sign(qd)*exp(-abs(qd/velocity)**power)",)
    formula = "Fls |load| exp(-|qd/velocity|^power) sign(qd)"
    revolute_units = ("1",)
    prismatic_units = ("1",)
    nonlinear = FADING
    ratio_powers = (0.0,)
