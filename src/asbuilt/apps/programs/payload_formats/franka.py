"""Franka: `setLoad` of libfranka, or Desk's description of an end effector in a `.json` file.

Sources: libfranka, `franka/robot.h`, `Robot::setLoad(load_mass [kg], F_x_Cload [m] from the flange,
load_inertia [kg m^2], column-major)`. The point of the inertia is not stated there; libfranka's
model takes it about the centre of mass in the axes of the flange, as does `I_load` of its robot
state. `setLoad` is for what a hand carries; Desk holds the end effector, and both add up. Fields of
Desk (`mass`, `centerOfMass`, `inertia` of nine and `transformation` of sixteen numbers, column by
column, 0.001 kg m^2 about each axis by default) are those that Desk 3.0.2 sends to the robot
(lock_arms.py of a public client); no manual that states them was found. `transformation` is the
place of the tool point, which a recording does not tell: it stays at the flange.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from asbuilt.apps.programs.naming import format_decimals, list_decimals
from asbuilt.codec import format_json
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, PayloadFormat

DEFAULT_INERTIA = 0.001
"""Moment of Desk's default end effector about each axis [kg m^2]."""


class Franka(PayloadFormat):
    """A call in C++, or Desk's JSON, which has no comments."""

    key = "franka"
    title = "Franka (libfranka; .json: Desk)"
    frames = ("link8", "flange", "tool0")
    comment = "//"

    def remark(self, body: CarriedBody, notes: tuple[str, ...], path: Path) -> str:
        """Return comments, none in JSON."""
        return "" if _is_desk(path) else super().remark(body, notes, path)

    def document(self, body: CarriedBody, path: Path) -> str:
        """Return the call or the document."""
        if _is_desk(path):
            inertia = DEFAULT_INERTIA * np.eye(3) if body.is_point else body.inertia
            return format_json(
                {
                    "mass": body.mass,
                    "centerOfMass": body.centre,
                    "inertia": inertia.ravel(order="F"),
                    "transformation": np.eye(4).ravel(order="F"),
                }
            )
        columns = list_decimals(body.inertia.ravel(order="F"))
        return (
            f"robot.setLoad({format_decimals(body.mass)}, {{{{{list_decimals(body.centre)}}}}},\n"
            f"              {{{{{columns}}}}});\n"
        )


def _is_desk(path: Path) -> bool:
    return path.suffix.lower() == ".json"


PAYLOAD_FORMATS.register(Franka.key, Franka())
