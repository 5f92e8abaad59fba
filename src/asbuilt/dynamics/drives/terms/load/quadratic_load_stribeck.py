"""Friction with the square of the load near standstill, by the direction of the power."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, NonlinearValue, drive_term
from asbuilt.dynamics.drives.terms.load.fading import FADING


@drive_term
class QuadraticLoadStribeck(DriveTerm):
    """Add `load^2 exp(-|qd / velocity|^power) sign(qd)` times Flqm or Flqe.

    Flqm counts where the motor drives (`load qd > 0`), Flqe where the load drives.

    Source: Duclusaud, Passault, Padois and Ly, arXiv 2410.08650, 2024: model M6.
    """

    velocity: NonlinearValue = None
    power: NonlinearValue = None

    key = "quadratic_load_stribeck"
    title = "quadratic load-dependent Stribeck friction"
    position = 68
    symbols = ("Flqm", "Flqe")
    columns = (
        "maximum(load*sign(qd), 0)**2*sign(qd)*exp(-abs(qd/velocity)**power)",
        "maximum(-load*sign(qd), 0)**2*sign(qd)*exp(-abs(qd/velocity)**power)",
    )
    formula = "(Flqm max(load sign(qd), 0)^2 + Flqe max(-load sign(qd), 0)^2) s(qd) sign(qd)"
    revolute_units = ("1/(N m)", "1/(N m)")
    prismatic_units = ("1/N", "1/N")
    nonlinear = FADING
    ratio_powers = (-1.0, -1.0)
