"""Robots from Denavit-Hartenberg parameters, standard (distal) or modified (proximal)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.finite import parse_finite_number, read_rows
from asbuilt.description.formats.description_format import DESCRIPTION_FORMATS, DescriptionFormat
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.lengths import NO_SYMBOLS, add_symbols, drop_empty_symbols, rotate_symbols
from asbuilt.description.model import (
    ROOT,
    USUAL_GRAVITY,
    DriveValues,
    Joint,
    JointKind,
    JointLimits,
    Link,
    RobotModel,
    Symbols,
)
from asbuilt.description.rotation import (
    compose_placements,
    placement,
    rotation_x,
    rotation_z,
    straighten_angle,
)
from asbuilt.errors import DescriptionError

Convention = Literal["standard", "modified"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DHRow:
    """One joint and its link by the four Denavit-Hartenberg parameters.

    Lengths a, b [m], angles alpha, theta [rad].

    `b` is the joint offset along z (d in many textbooks). `theta` is added to the joint angle of a
    revolute joint and `b` to the displacement of a prismatic one. `parent` is the index of the
    parent row (None: the row before; ROOT: the root link). `origin` (4, 4) is an extra placement in
    front of the row, such as a pedestal. `inertia` is about the origin of the row's frame, in its
    axes.
    """

    a: float = 0.0
    alpha: float = 0.0
    b: float = 0.0
    theta: float = 0.0
    kind: JointKind = "revolute"
    inertia: LinkInertia | None = None
    joint: str = ""
    parent: int | None = None
    origin: Array | None = None
    limits: JointLimits = field(default_factory=JointLimits)
    drive: DriveValues = field(default_factory=DriveValues)


def robot_from_dh(
    rows: Sequence[DHRow],
    *,
    convention: Convention = "standard",
    name: str = "robot",
    gravity: ArrayLike = USUAL_GRAVITY,
    source: str = "",
    notes: Sequence[str] = (),
) -> RobotModel:
    """Build a robot from Denavit-Hartenberg rows.

    Standard (Denavit and Hartenberg, 1955; Spong): `T = RotZ(theta) TransZ(b) TransX(a)
    RotX(alpha)`, the joint turns about z of the parent frame. Modified (Craig; Khalil and
    Kleinfinger, 1986): `T = RotX(alpha) TransX(a) RotZ(theta) TransZ(b)`, the joint turns about z
    of its own frame. Non-zero lengths get the symbols `a<i>` and `b<i>` of their row i, also in the
    modified convention, where textbooks count `a` one lower. Angles within 1e-5 rad of a right
    angle become exact, with a note where this moves them by more than 1e-9.

    Raises `DescriptionError` for an unknown convention, numbers that are not finite, and rows that
    hang on later ones.

    >>> arm = robot_from_dh([DHRow(a=0.5), DHRow(a=0.4)], name="planar")
    >>> arm.n_joints, dict(arm.lengths)
    (2, {'a1': 0.5, 'a2': 0.4})
    """
    if convention not in ("standard", "modified"):
        raise DescriptionError(
            f"{name}: the Denavit-Hartenberg convention {convention!r} is unknown; it is 'standard'"
            " or 'modified'"
        )
    lengths: dict[str, float] = {}
    remarks = list(notes)
    joints = []
    for i, row in enumerate(rows):
        joints.append(build_dh_joint(row, i, convention, remarks))
        lengths |= dh_lengths(row, i)
    return RobotModel(
        name=name,
        joints=tuple(joints),
        links=tuple(
            Link(
                name=f"link_{i + 1}",
                inertia=row.inertia or LinkInertia.zero(),
                inertia_known=row.inertia is not None,
            )
            for i, row in enumerate(rows)
        ),
        gravity=np.asarray(gravity, dtype=np.float64),
        lengths=lengths,
        source=source,
        notes=tuple(remarks),
    )


def dh_lengths(row: DHRow, index: int) -> dict[str, float]:
    """Return the symbols of the non-zero lengths of a row and their values [m]."""
    return {
        symbol: value
        for symbol, value in ((f"a{index + 1}", row.a), (f"b{index + 1}", row.b))
        if value != 0.0
    }


def build_dh_joint(row: DHRow, index: int, convention: Convention, notes: list[str]) -> Joint:
    """Return the joint of a Denavit-Hartenberg row.

    `notes` takes a remark on every angle that was straightened.

    Raises `DescriptionError` for numbers that are not finite and for a parent that is no earlier
    row.
    """
    number = index + 1
    for column, value in (("a", row.a), ("alpha", row.alpha), ("b", row.b), ("theta", row.theta)):
        if not np.isfinite(value):
            raise DescriptionError(
                f"{column} of row {number} is {value}; it must be a finite number"
            )
    alpha = straighten_angle(row.alpha, f"alpha of row {number}", notes)
    theta = straighten_angle(row.theta, f"theta of row {number}", notes)
    parent = index - 1 if row.parent is None else row.parent
    if not ROOT <= parent < index:
        raise DescriptionError(
            f"row {number} hangs on row {parent + 1}; a row may only hang on an earlier row or on"
            " the root"
        )
    along_x = ((1.0, f"a{number}"),) if row.a != 0.0 else ()
    along_z = ((1.0, f"b{number}"),) if row.b != 0.0 else ()
    tilt = rotation_x(alpha)
    before_symbols: Symbols | None = None
    after_symbols: Symbols | None = None
    if convention == "standard":
        before = placement(rotation_z(theta))
        after = placement(tilt, (row.a, 0.0, row.b))
        after_symbols = (along_x, (), along_z)
    else:
        before = compose_placements(
            placement(tilt, (row.a, 0.0, 0.0)), placement(rotation_z(theta), (0.0, 0.0, row.b))
        )
        after = np.eye(4)
        before_symbols = add_symbols((along_x, (), ()), rotate_symbols(tilt, ((), (), along_z)))
    joint = Joint(
        name=row.joint or f"joint_{number}",
        kind=row.kind,
        parent=parent,
        before=before,
        after=after,
        limits=row.limits,
        drive=row.drive,
        before_symbols=drop_empty_symbols(before_symbols),
        after_symbols=drop_empty_symbols(after_symbols),
    )
    return joint if row.origin is None else place_joint_on_origin(joint, row.origin)


def place_joint_on_origin(
    joint: Joint, origin: Array, origin_symbols: Symbols | None = None
) -> Joint:
    """Return the joint with a placement (4, 4) in front of it.

    Symbols survive where both translations are zero or have symbols.
    """
    before = compose_placements(origin, joint.before)
    local = joint.before_symbols or (None if joint.before[:3, 3].any() else NO_SYMBOLS)
    ahead = origin_symbols or (None if origin[:3, 3].any() else NO_SYMBOLS)
    symbols = (
        None
        if local is None or ahead is None
        else add_symbols(ahead, rotate_symbols(origin[:3, :3], local))
    )
    return replace(joint, before=before, before_symbols=drop_empty_symbols(symbols))


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
    lines, _ = read_rows(path, ",", "link")
    columns = [name.strip() for name in lines[0][1]]
    _check_columns(path, columns)
    rows = []
    table_notes = []
    for line, cells in lines[1:]:
        if len(cells) != len(columns):
            raise DescriptionError(
                f"{path}, line {line}: {len(cells)} cells, but the header has {len(columns)}"
                " columns"
            )
        rows.append(
            _read_row(
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
    known = {"link", *GEOMETRY_COLUMNS, *MASS_COLUMNS, "theta_deg", "kind"}
    repeated = min((name for name in columns if columns.count(name) > 1), default=None)
    missing = [name for name in (*GEOMETRY_COLUMNS, *MASS_COLUMNS) if name not in columns]
    unknown = next((name for name in columns if name not in known), None)
    if repeated is not None:
        raise DescriptionError(f"{path}: column {repeated!r} appears twice")
    if not set(GEOMETRY_COLUMNS) & set(columns):
        raise DescriptionError(
            f"{path} is no table of Denavit-Hartenberg parameters: it has columns"
            f" {', '.join(columns[:8])}, none of {', '.join(GEOMETRY_COLUMNS)}; if it is a"
            " recording, name the robot before it"
        )
    if missing:
        raise DescriptionError(
            f"{path}: column {', '.join(missing)} is missing; the table needs"
            f" {', '.join((*GEOMETRY_COLUMNS, *MASS_COLUMNS))}"
        )
    if unknown is not None:
        raise DescriptionError(
            f"{path}: column {unknown!r} is unknown; known are {', '.join(sorted(known))}"
        )


def _read_row(place: str, cells: dict[str, str]) -> DHRow:
    def number(column: str) -> float:
        return parse_finite_number(cells.get(column, "0"), f"{place}: {column}")

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


DESCRIPTION_FORMATS.register("dh_table", DescriptionFormat("DH table", (".csv",), read_dh_table))
