"""Directional load-dependent friction near standstill, fading with speed."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import (
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


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
    nonlinear = (
        NonlinearParameter(
            "velocity", 0.1, 1e-3, 5.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
        ),
        NonlinearParameter("power", 2.0, 0.5, 10.0, "", fitted=False, typical=2.0),
    )
    ratio_powers = (0.0, 0.0)
