"""Doosan: `add_tool`, as in DRL and over ROS 2.

Source: Doosan Robotics API manual (GL013301), `CDRFLEx::add_tool(strSymbol, fWeight, fCog,
fInertia)`: weight in kilograms, centre of gravity in millimetres from the flange, inertia (Ixx,
Iyy, Izz, Ixy, Ixz, Iyz). The unit [kg m^2] and the point of the inertia, taken here as the centre
of gravity, are not stated there (`CONFIG_TOOL` of the same manual names metres for the centre of a
tool that is read back); look at the values on the teach pendant once.
"""

from __future__ import annotations

from pathlib import Path

from asbuilt.apps.programs.naming import (
    MILLIMETRES,
    format_decimals,
    list_decimals,
    list_inertia,
)
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, PayloadFormat


class Doosan(PayloadFormat):
    """Two lines of DRL."""

    key = "doosan"
    title = "Doosan (DRL)"

    def notes(self, body: CarriedBody) -> tuple[str, ...]:
        """Return the notes of every format, and what its manual leaves open."""
        unit = "the manual does not state point and unit of the inertia: compare on the pendant"
        return (*super().notes(body), *([] if body.is_point else [unit]))

    def document(self, body: CarriedBody, path: Path) -> str:
        """Return the calls."""
        centre = list_decimals(MILLIMETRES * body.centre)
        inertia = list_decimals(list_inertia(body.inertia))
        return (
            f'add_tool("asbuilt", {format_decimals(body.mass)}, [{centre}],\n'
            f"         [{inertia}])\n"
            'set_tool("asbuilt")\n'
        )


PAYLOAD_FORMATS.register(Doosan.key, Doosan())
