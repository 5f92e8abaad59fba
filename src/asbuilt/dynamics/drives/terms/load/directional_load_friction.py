"""Load-dependent friction that differs where the motor drives and where the load drives."""

from __future__ import annotations

from asbuilt.dynamics.drives.term import DriveTerm, drive_term


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
    prismatic_units = ("1", "1")
    non_negative = True
    ratio_powers = (0.0, 0.0)
