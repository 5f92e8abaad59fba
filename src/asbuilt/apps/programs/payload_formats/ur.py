"""Universal Robots: `set_target_payload` of URScript.

Source: Universal Robots, Script Manual (PolyScope 5, SW 10.6), `set_target_payload(m, cog, inertia,
transition_time)`: mass [kg]; centre [CoGx, CoGy, CoGz] [m] from the tool mount; inertia [Ixx, Iyy,
Izz, Ixy, Ixz, Iyz] [kg m^2] with origin in the centre of gravity and the axes of the tool flange; a
zero matrix where it is left out. "Inertia matrix": the products have the signs of its entries. The
axes of the tool flange are those of `tool0` in the maker's ROS description, not of its `flange`.
"""

from __future__ import annotations

from pathlib import Path

from asbuilt.apps.programs.naming import format_decimals, list_decimals, list_inertia
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, PayloadFormat


class UniversalRobots(PayloadFormat):
    """One line of URScript."""

    key = "ur"
    title = "Universal Robots (URScript)"

    def document(self, body: CarriedBody, path: Path) -> str:
        """Return the call."""
        arguments = [format_decimals(body.mass), f"[{list_decimals(body.centre)}]"]
        if not body.is_point:
            arguments.append(f"[{list_decimals(list_inertia(body.inertia))}]")
        return f"set_target_payload({', '.join(arguments)})\n"


PAYLOAD_FORMATS.register(UniversalRobots.key, UniversalRobots())
