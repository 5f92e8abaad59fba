"""Friction by the load of gears and bearings."""

from __future__ import annotations

from typing import ClassVar

from asbuilt.dynamics.drives.term import (
    ALL_SOURCES,
    DriveTerm,
    NonlinearParameter,
    NonlinearValue,
    drive_term,
)


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
    tried_for = ALL_SOURCES
    non_negative = True
    ratio_powers = (0.0,)


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
    symbols: ClassVar[tuple[str, ...]] = ("Fls",)
    columns: ClassVar[tuple[str, ...]] = ("abs(load)*sign(qd)*exp(-abs(qd/velocity)**power)",)
    formula = "Fls |load| exp(-|qd/velocity|^power) sign(qd)"
    revolute_units: ClassVar[tuple[str, ...]] = ("1",)
    nonlinear = (
        NonlinearParameter(
            "velocity", 0.1, 1e-3, 5.0, "rad/s", typical=2.0, speed=True, credible=(0.0, 0.1)
        ),
        NonlinearParameter("power", 2.0, 0.5, 10.0, "", fitted=False, typical=2.0),
    )
    ratio_powers: ClassVar[tuple[float, ...]] = (0.0,)


@drive_term
class DirectionalLoadFriction(DriveTerm):
    """Add `|load| sign(qd)` times Flm where `load qd > 0`, times Fle where `load qd < 0`.

    Of a gear that is less efficient one way: the motor drives where the rigid-body torque has the
    sign of the velocity. It contains `load_friction`, in whose place it comes. The differences
    Flm - Fle of all joints together are the rigid-body torque, so that one direction, a common
    factor of all links against them, is never determined by torques.

    Source: Duclusaud, Passault, Padois and Ly, arXiv 2410.08650, 2024: model M5, solved for the
    torque of the motor in motion.
    """

    key = "directional_load_friction"
    title = "directional load-dependent friction"
    position = 64
    symbols = ("Flm", "Fle")
    columns = (
        "maximum(load*sign(qd), 0)*sign(qd)",
        "maximum(-load*sign(qd), 0)*sign(qd)",
    )
    formula = "(Flm max(load sign(qd), 0) + Fle max(-load sign(qd), 0)) sign(qd)"
    revolute_units = ("1", "1")
    non_negative = True
    ratio_powers = (0.0, 0.0)


@drive_term
class DirectionalLoadStribeck(LoadStribeck):
    """Add `directional_load_friction` times `exp(-|qd / velocity|^power)`.

    Source: Duclusaud, Passault, Padois and Ly, arXiv 2410.08650, 2024: model M5.
    """

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
    ratio_powers = (0.0, 0.0)


@drive_term
class QuadraticLoadStribeck(LoadStribeck):
    """Add `load^2 exp(-|qd / velocity|^power) sign(qd)` times Flqm or Flqe.

    Flqm counts where the motor drives (`load qd > 0`), Flqe where the load drives.

    Source: Duclusaud, Passault, Padois and Ly, arXiv 2410.08650, 2024: model M6.
    """

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
    ratio_powers = (-1.0, -1.0)
