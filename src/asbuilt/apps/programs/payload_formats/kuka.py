"""KUKA: `$LOAD` of KRL.

Sources: KUKA, Assembly instructions KR IONTEC V4 (2021), "Load center of gravity and mass moment of
inertia": mass [kg], Lx Ly Lz [mm], A B C [degrees] the orientation of the principal axes - A about
Z, then B about the new Y, then C about the new X - and Ix Iy Iz [kg m^2] about the axes of that
system, whose origin is the centre of mass. Beckhoff TF5120, KRC_WriteLoadData: X Y Z and A B C are
relative to the flange. The structure `{M, CM {X, Y, Z, A, B, C}, J {X, Y, Z}}` is that of
LOAD_DATA as KUKA's load data determination shows it. Not verified in a manual: that J of zeros is
the default of a load that is entered by hand.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from asbuilt.apps.programs.naming import (
    MILLIMETRES,
    find_principal_axes,
    format_decimals,
)
from asbuilt.description import rpy_from_rotation
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, PayloadFormat


class Kuka(PayloadFormat):
    """One assignment of KRL; the same structure is LOAD_DATA of a tool."""

    key = "kuka"
    title = "KUKA (KRL)"
    comment = ";"

    def document(self, body: CarriedBody, path: Path) -> str:
        """Return the assignment."""
        moments, axes = find_principal_axes(body.inertia)
        # Roll, pitch and yaw about fixed axes are C, B and A about the turned ones.
        c, b, a = np.degrees(rpy_from_rotation(axes))
        centre = _name_values("XYZABC", [*MILLIMETRES * body.centre, a, b, c])
        inertia = _name_values("XYZ", moments)
        return f"$LOAD = {{M {format_decimals(body.mass)}, CM {{{centre}}}, J {{{inertia}}}}}\n"


def _name_values(letters: str, values: list[float] | np.ndarray) -> str:
    return ", ".join(
        f"{letter} {format_decimals(value)}" for letter, value in zip(letters, values, strict=True)
    )


PAYLOAD_FORMATS.register(Kuka.key, Kuka())
