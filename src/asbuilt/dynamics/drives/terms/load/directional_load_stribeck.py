"""Directional load-dependent friction near standstill, fading with speed."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, NonlinearValue, drive_term
from asbuilt.dynamics.drives.terms.load.fading import FADING


@drive_term
class DirectionalLoadStribeck(DriveTerm):
    """Add `directional_load_friction` times `exp(-|qd / velocity|^power)`.

    Source: Duclusaud, Passault, Padois and Ly, arXiv 2410.08650, 2024: model M5.
    """

    velocity: NonlinearValue = None
    power: NonlinearValue = None

    key = "directional_load_stribeck"
    title = "directional load-dependent Stribeck friction"
    position = 66
    symbols = ("Flsm", "Flse")
    columns = (
        "maximum(load*sign(qd), 0)*sign(qd)*exp(-abs(qd/velocity)**power)",
        "maximum(-load*sign(qd), 0)*sign(qd)*exp(-abs(qd/velocity)**power)",
    )
    formula = "(Flsm max(load sign(qd), 0) + Flse max(-load sign(qd), 0)) s(qd) sign(qd)"
    revolute_units = ("1", "1")
    prismatic_units = ("1", "1")
    nonlinear = FADING
    ratio_powers = (0.0, 0.0)
