"""Friction near standstill beyond Coulomb friction, fading with speed."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import (
    ALL_SOURCES,
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


@drive_term
class Stribeck(DriveTerm):
    """Add `Fs exp(-|qd / velocity|^power) sign(qd)` to Coulomb friction.

    The velocity is that at which lubricant begins to part the surfaces: 1e-5 to 0.1 m/s of sliding.
    On a motor shaft of 2 cm radius behind a gear of 50 or more that is at most 0.1 rad/s at the
    joint; a tenth of the top speed, 0.2 to 0.3 rad/s for most arms, is a generous bound for a fit.
    What fades at higher speeds has another cause, such as grease that thins with shear.

    Source: Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30, 1994, section 2.
    """

    velocity: NonlinearValue = None
    power: NonlinearValue = None

    key = "stribeck"
    title = "Stribeck friction"
    position = 40
    symbols = ("Fs",)
    columns = ("sign(qd)*exp(-abs(qd/velocity)**power)",)
    formula = "Fs exp(-|qd/velocity|^power) sign(qd)"
    revolute_units = ("N m",)
    prismatic_units = ("N",)
    nonlinear = (
        NonlinearParameter(
            "velocity", 0.1, 1e-3, 5.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
        ),
        NonlinearParameter("power", 2.0, 0.5, 4.0, "", fitted=False, typical=2.0),
    )
    tried_for = ALL_SOURCES
