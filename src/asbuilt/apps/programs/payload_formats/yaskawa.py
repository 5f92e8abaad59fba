"""Yaskawa: the load of a TOOL file, or a preset of the Smart Pendant in a `.yps` file.

Sources: Yaskawa, NX100 Operator's Manual 9.11 and DX100 8.4, ARM control, tool load: W [kg]; Xg Yg
Zg [mm] in flange coordinates; Ix Iy Iz [kg m^2] about axes through the centre of gravity, parallel
to those of the flange. Yaskawa Smart Pendant, "Presets files": a tool has `weight` [kg], `com`
[mm] from the tool plate, `moi` [Ixx, Iyy, Izz] [kg m^2]; `offset` and `orient`, the tool point,
have defaults. There is no place for products of inertia, and the inertia "need not usually be set".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from asbuilt.apps.programs.naming import MILLIMETRES, format_decimals, list_decimals
from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, PayloadFormat


class Yaskawa(PayloadFormat):
    """A table of the fields, or a preset, whose comments are those of C."""

    key = "yaskawa"
    title = "Yaskawa (fields of TOOL; .yps: preset of the Smart Pendant)"
    has_products = False

    def remark(self, body: CarriedBody, notes: tuple[str, ...], path: Path) -> str:
        """Return comments in the file's language."""
        lines = super().remark(body, notes, path)
        return lines.replace("# ", "// ") if _is_preset(path) else lines

    def document(self, body: CarriedBody, path: Path) -> str:
        """Return a line a field, or the preset."""
        centre = MILLIMETRES * body.centre
        moments = np.diagonal(body.inertia)
        if _is_preset(path):
            return _write_preset(body.mass, centre, moments)
        rows = {
            "W": (body.mass, "kg"),
            **{f"{axis}g": (x, "mm") for axis, x in zip("XYZ", centre, strict=True)},
            **{f"I{axis}": (x, "kg.m2") for axis, x in zip("xyz", moments, strict=True)},
        }
        return "".join(
            f"{name:<3} {format_decimals(value)} {unit}\n" for name, (value, unit) in rows.items()
        )


def _write_preset(mass: float, centre: np.ndarray, moments: np.ndarray) -> str:
    inertia = f"      moi: [{list_decimals(moments)}],\n" if np.any(moments) else ""
    return (
        "{\n"
        '  filetype: "presets",\n'
        "  presets: [\n"
        "    {\n"
        '      preset: "tool",\n'
        '      id: "asbuilt.payload",\n'
        '      displayNames: { "en": "payload as identified" },\n'
        f"      weight: {format_decimals(mass)},\n"
        f"      com: [{list_decimals(centre)}],\n"
        f"{inertia}"
        "    }\n"
        "  ]\n"
        "}\n"
    )


def _is_preset(path: Path) -> bool:
    return path.suffix.lower() == ".yps"


PAYLOAD_FORMATS.register(Yaskawa.key, Yaskawa())
