"""Mass properties of links from a table that CAD software exported."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from asbuilt.apps.masses.cad.meshes import LENGTH, CadLink
from asbuilt.arrays import Array
from asbuilt.description import Link, LinkInertia, parse_finite_number, read_rows
from asbuilt.errors import DescriptionError

MASS = {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": 0.45359237, "lbm": 0.45359237}
_FACTOR = re.compile(r"([a-zA-Zµ]+)(?:\^?(-?\d+)|([²³]))?")
_SUPERSCRIPT = {"²": 2, "³": 3}
COLUMNS: dict[str, tuple[str, ...]] = {
    "link": ("link", "body"),
    "part": ("part", "component", "name"),
    "mass": ("mass", "m"),
    "cx": ("cx", "rx", "x", "comx"),
    "cy": ("cy", "ry", "y", "comy"),
    "cz": ("cz", "rz", "z", "comz"),
    "Ixx": ("ixx", "lxx"),
    "Iyy": ("iyy", "lyy"),
    "Izz": ("izz", "lzz"),
    "Ixy": ("ixy", "lxy", "iyx"),
    "Ixz": ("ixz", "lxz", "izx"),
    "Iyz": ("iyz", "lyz", "izy"),
}
"""Our name of each column and the names it goes by, without case, blanks and underscores."""

DIMENSION = (
    {"mass": (1, 0)}
    | dict.fromkeys(("cx", "cy", "cz"), (0, 1))
    | dict.fromkeys(("Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"), (1, 2))
)

_HEADER = re.compile(r"^\s*(?P<name>[^\[(]+?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?\s*$")


def read_cad_table(
    path: str | Path,
    *,
    about: Literal["com", "origin"],
    products: Literal["tensor", "integral"],
    mass_unit: str = "",
    length_unit: str = "",
    placements: Mapping[str, Array] | None = None,
) -> dict[str, CadLink]:
    """Read the mass properties of links from a CSV table, one row per part.

    Rows of one link add up.

    Columns `link, part, mass, cx, cy, cz, Ixx, Iyy, Izz, Ixy, Ixz, Iyz` (part is optional, other
    usual names are understood). Units stand in the header, as in `mass [g]` and `Ixx [g mm^2]`, or
    are given as `mass_unit` and `length_unit`; nothing is assumed. Two conventions must be given
    because files do not say them: the tensor is `about` the centre of mass or the origin of the
    axes, and its `products` are the entries of the tensor, `-integral(x y dm)`, or the plain
    integrals `+integral(x y dm)`. `placements` gives the pose (4, 4) of the axes of the table in
    the frame of a link where the two differ. Raises `DescriptionError` with line and column.
    """
    path = Path(path)
    if about not in ("com", "origin") or products not in ("tensor", "integral"):
        raise DescriptionError(
            f"{path}: about is {about!r} and products {products!r}; say about='com' or 'origin' and"
            " products='tensor' or 'integral'"
        )
    lines, separator = read_rows(path, ";\t,", "part")
    decimal_point = "," if separator == "," else "."  # which a comma in a number stands for
    columns, factors = _find_columns(path, lines[0][1], mass_unit, length_unit)
    parts: dict[str, list[tuple[str, LinkInertia]]] = {}
    warnings: dict[str, list[str]] = {}
    for number, cells in lines[1:]:
        place = f"{path}, line {number}"
        if len(cells) < len(lines[0][1]) or any(cell.strip() for cell in cells[len(lines[0][1]) :]):
            raise DescriptionError(
                f"{place}: {len(cells)} cells, but the header has {len(lines[0][1])} columns; where"
                " numbers have decimal commas, separate cells by semicolons"
            )
        values = {
            name: (
                parse_finite_number(
                    cells[columns[name]].strip().replace(",", decimal_point), f"{place}: {name}"
                )
                * factors[name]
            )
            for name in DIMENSION
        }
        link = cells[columns["link"]].strip()
        inertia = _make_inertia(values, about, products)
        if placements is not None and link in placements:
            inertia = inertia.moved(placements[link])
        part = (
            cells[columns["part"]].strip()
            if "part" in columns
            else f"part_{len(parts.get(link, [])) + 1}"
        )
        parts.setdefault(link, []).append((part, inertia))
        reason = inertia.inconsistency()
        if reason is not None:
            doubt = (
                f"link {link!r}, part {part!r}: {reason}; check units, about={about!r} and"
                f" products={products!r}"
            )
            warnings.setdefault(link, []).append(doubt)
    return {
        link: CadLink(
            Link(
                name=link,
                inertia=LinkInertia(np.sum([inertia.parameters for _, inertia in bodies], axis=0)),
                parts=tuple(bodies),
            ),
            tuple(warnings.get(link, ())),
        )
        for link, bodies in parts.items()
    }


def _make_inertia(values: Mapping[str, float], about: str, products: str) -> LinkInertia:
    sign = 1.0 if products == "tensor" else -1.0
    xy, xz, yz = (sign * values[name] for name in ("Ixy", "Ixz", "Iyz"))
    tensor = np.array([[values["Ixx"], xy, xz], [xy, values["Iyy"], yz], [xz, yz, values["Izz"]]])
    com = np.array([values["cx"], values["cy"], values["cz"]])
    mass = values["mass"]
    return (
        LinkInertia.from_com(mass, com, tensor)
        if about == "com"
        else LinkInertia.from_origin(mass, mass * com, tensor)
    )


def _find_columns(
    path: Path, header: list[str], mass_unit: str, length_unit: str
) -> tuple[dict[str, int], dict[str, float]]:
    columns: dict[str, int] = {}
    factors: dict[str, float] = {}
    for position, cell in enumerate(header):
        match = _HEADER.match(cell)
        plain = re.sub(r"[\s_]", "", match["name"]).lower() if match else ""
        name = next((ours for ours, names in COLUMNS.items() if plain in names), None)
        if match is None or name is None:
            continue
        if name in columns:
            raise DescriptionError(f"{path}: column {cell.strip()!r} gives {name} a second time")
        columns[name] = position
        if name in DIMENSION:
            mass, length = DIMENSION[name]
            given = match["unit"] or " ".join(
                [mass_unit] * mass
                + [f"{length_unit}^{length}"] * (length > 0 and bool(length_unit))
            )
            if not given.strip():
                raise DescriptionError(
                    f"{path}: column {cell.strip()!r} states no unit; write it like 'Ixx [g mm^2]'"
                    " or give mass_unit and length_unit"
                )
            try:
                factors[name] = parse_unit_factor(given, mass=mass, length=length)
            except DescriptionError as error:
                raise DescriptionError(f"{path}: column {cell.strip()!r}: {error}") from None
    missing = [name for name in COLUMNS if name not in columns and name != "part"]
    if missing:
        raise DescriptionError(
            f"{path}: column {', '.join(missing)} is missing; found"
            f" {', '.join(cell.strip() for cell in header)}"
        )
    return columns, factors


def parse_unit_factor(text: str, *, mass: int, length: int) -> float:
    """Return the SI value of a unit such as `"g mm^2"`, `"kg*m²"` or `"lb in2"`.

    It must be mass^mass length^length.

    Raises `DescriptionError` where a symbol is unknown or the dimension is another one.

    >>> parse_unit_factor("g mm^2", mass=1, length=2)
    1e-09
    """
    value = 1.0
    found_mass = 0
    found_length = 0
    if _FACTOR.sub("", text).strip(" *·.()") or not text.strip():
        raise DescriptionError(f"the unit {text!r} is not understood; write it like 'g mm^2'")
    for symbol, power, superscript in _FACTOR.findall(text):
        exponent = _SUPERSCRIPT.get(superscript) or int(power or 1)
        if symbol in MASS:
            found_mass += exponent
            value *= MASS[symbol] ** exponent
        elif symbol in LENGTH:
            found_length += exponent
            value *= LENGTH[symbol] ** exponent
        else:
            raise DescriptionError(
                f"the unit {text!r} holds {symbol!r}, which is unknown; known are"
                f" {', '.join([*MASS, *LENGTH])}"
            )
    if (found_mass, found_length) != (mass, length):
        raise DescriptionError(
            f"the unit {text!r} is mass^{found_mass} length^{found_length}; expected mass^{mass}"
            f" length^{length}"
        )
    return value
