"""FANUC: the fields of the screen MOTION/PAYLOAD SET.

Sources: Lincoln Electric's edition of FANUC's manual, table "MOTION/PAYLOAD SET Screen Items":
PAYLOAD [kg], PAYLOAD CENTER X, Y, Z [cm] from the centre of the faceplate, Z outwards. The
inertias are in kgf cm s^2, of which 1 kg m^2 is 100 / 9.80665, about the centre of mass
(robot-forum.com, thread 37725, which cites FANUC's payload checker); no manual was found that says
the point. Inertia is not specified by default. There is no place for products of inertia. The
system variables `$PLST_GRP1[n].$PAYLOAD_IX` have another unit, which was not found: only the screen
is written.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from asbuilt.apps.programs.naming import format_decimals
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, PayloadFormat

CENTIMETRES = 100.0
"""Centimetres in a metre."""
FORCE_UNITS = CENTIMETRES / 9.80665
"""kgf cm s^2 in one kg m^2: standard gravity defines the kilogram of force."""


class Fanuc(PayloadFormat):
    """A table of the fields."""

    key = "fanuc"
    title = "FANUC (fields of MOTION/PAYLOAD SET)"
    has_products = False

    def document(self, body: CarriedBody, path: Path) -> str:
        """Return a line a field."""
        rows = {"PAYLOAD [kg]": body.mass}
        for axis, value in zip("XYZ", CENTIMETRES * body.centre, strict=True):
            rows[f"PAYLOAD CENTER {axis} [cm]"] = value
        for axis, value in zip("XYZ", FORCE_UNITS * np.diagonal(body.inertia), strict=True):
            rows[f"PAYLOAD INERTIA {axis} [kgf cm s^2]"] = value
        return "".join(f"{name:<31} {format_decimals(value)}\n" for name, value in rows.items())


PAYLOAD_FORMATS.register(Fanuc.key, Fanuc())
