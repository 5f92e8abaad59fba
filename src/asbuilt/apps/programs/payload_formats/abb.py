"""ABB: `loaddata` of RAPID.

Source: ABB, Technical reference manual, RAPID Instructions, Functions and Data types, `loaddata`
(as in abb_rapid_msgs/LoadData, and RAPID Reference Manual, `tooldata`): mass [kg]; cog [mm]; aom,
the principal axes of the moment of inertia with origin in cog as a quaternion q1 to q4, q1 the real
part; ix iy iz [kg m^2] about these axes; a point mass where all three are zero. The load of a tool
is in the wrist frame, that of tool0; a payload for `GripLoad` is in the frame of the active tool.
"""

from __future__ import annotations

from pathlib import Path

from asbuilt.apps.programs.naming import (
    MILLIMETRES,
    find_principal_axes,
    format_decimals,
    list_decimals,
)
from asbuilt.description import quaternion_from_rotation
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, PayloadFormat


class Abb(PayloadFormat):
    """One declaration of RAPID."""

    key = "abb"
    title = "ABB (RAPID)"
    comment = "!"

    def notes(self, body: CarriedBody) -> tuple[str, ...]:
        """Return the notes of every format, and where the load is to be used."""
        use = "for the load of a tool, or for GripLoad with the active tool tool0"
        return (*super().notes(body), use)

    def document(self, body: CarriedBody, path: Path) -> str:
        """Return the declaration."""
        moments, axes = find_principal_axes(body.inertia)
        centre = list_decimals(MILLIMETRES * body.centre, ",")
        turned = list_decimals(quaternion_from_rotation(axes), ",")
        return (
            f"PERS loaddata asbuilt_load := [{format_decimals(body.mass)},[{centre}],[{turned}],"
            f"{list_decimals(moments, ',')}];\n"
        )


PAYLOAD_FORMATS.register(Abb.key, Abb())
