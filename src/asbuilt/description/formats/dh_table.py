"""Robots from a CSV table of Denavit-Hartenberg parameters and mass properties.

The format is that of Table 1 of Hayat, Abhishek and Saha (2015).
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from asbuilt.description.finite import finite_number
from asbuilt.description.formats.dh import DHRow, robot_from_dh
from asbuilt.description.formats.registry import FORMATS, DescriptionFormat
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import JointKind, RobotModel
from asbuilt.errors import DescriptionError
from asbuilt.untrusted import read_text

GEOMETRY_COLUMNS = ("b", "a", "alpha_deg")
MASS_COLUMNS = ("m", "rx", "ry", "rz", "Ixx", "Iyy", "Izz", "Ixy", "Iyz", "Izx")
KINDS: dict[str, JointKind] = {
    "r": "revolute",
    "revolute": "revolute",
    "continuous": "continuous",
    "p": "prismatic",
    "prismatic": "prismatic",
}


def read_dh_table(path: str | Path) -> RobotModel:
    """Read a serial robot from a CSV table with one row per link.

    The convention is the standard (distal) one of Denavit and Hartenberg.

    Columns `link, b, a, alpha_deg` [m, deg]; `m` [kg], `rx ry rz` [m] centre of mass from the
    origin of the link's frame; `Ixx Iyy Izz Ixy Iyz Izx` [kg m^2] about the centre of mass; all in
    the axes of the link's frame. Optional: `theta_deg`, `kind` (revolute or prismatic). Raises
    `DescriptionError` with line and column.
    """
    path = Path(path)
    text = read_text(path, "table", DescriptionError)
    try:
        reader = csv.reader(text.splitlines(), skipinitialspace=True)
        lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise DescriptionError(f"{path}: the table cannot be read as CSV text: {error}") from None
    if len(lines) < 2:
        raise DescriptionError(
            f"{path}: the table has no rows; expected a header and one row per link"
        )
    columns = [name.strip() for name in lines[0][1]]
    _check_columns(path, columns)
    rows, table_notes = [], []
    for line, cells in lines[1:]:
        if len(cells) != len(columns):
            raise DescriptionError(
                f"{path}, line {line}: {len(cells)} cells, but the header has {len(columns)}"
                " columns"
            )
        rows.append(
            _row(
                f"{path}, line {line}",
                dict(zip(columns, (cell.strip() for cell in cells), strict=True)),
            )
        )
    last = rows[-1]
    if last.alpha != 0.0:
        table_notes.append(
            f"alpha of the last row is {math.degrees(last.alpha):g} deg: it turns no joint, only"
            f" the axes in which the mass properties of link {len(rows)} are read; make sure that"
            " they are given in these axes"
        )
    return robot_from_dh(rows, name=path.stem, source=str(path), notes=table_notes)


def _check_columns(path: Path, columns: list[str]) -> None:
    repeated = sorted({name for name in columns if columns.count(name) > 1})
    if repeated:
        raise DescriptionError(f"{path}: column {repeated[0]!r} appears twice")
    if not set(GEOMETRY_COLUMNS) & set(columns):
        raise DescriptionError(
            f"{path} is no table of Denavit-Hartenberg parameters: it has columns"
            f" {', '.join(columns[:8])}, none of {', '.join(GEOMETRY_COLUMNS)}; if it is a"
            " recording, name the robot before it"
        )
    missing = [name for name in (*GEOMETRY_COLUMNS, *MASS_COLUMNS) if name not in columns]
    if missing:
        raise DescriptionError(
            f"{path}: column {', '.join(missing)} is missing; the table needs"
            f" {', '.join((*GEOMETRY_COLUMNS, *MASS_COLUMNS))}"
        )
    known = {"link", *GEOMETRY_COLUMNS, *MASS_COLUMNS, "theta_deg", "kind"}
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise DescriptionError(
            f"{path}: column {unknown[0]!r} is unknown; known are {', '.join(sorted(known))}"
        )


def _row(place: str, cells: dict[str, str]) -> DHRow:
    def number(column: str) -> float:
        return finite_number(cells.get(column, "0"), f"{place}: {column}")

    kind = cells.get("kind", "revolute").lower()
    if kind not in KINDS:
        raise DescriptionError(f"{place}: kind is {kind!r}; it must be one of {', '.join(KINDS)}")
    xx, yy, zz, xy, yz, zx = (number(name) for name in ("Ixx", "Iyy", "Izz", "Ixy", "Iyz", "Izx"))
    tensor = np.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]])
    inertia = LinkInertia.from_com(number("m"), [number("rx"), number("ry"), number("rz")], tensor)
    return DHRow(
        a=number("a"),
        alpha=math.radians(number("alpha_deg")),
        b=number("b"),
        theta=math.radians(number("theta_deg")),
        kind=KINDS[kind],
        inertia=inertia,
    )


FORMATS.register("dh_table", DescriptionFormat("DH table", (".csv",), read_dh_table))
