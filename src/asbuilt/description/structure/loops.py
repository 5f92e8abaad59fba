"""Loops: a cut in a closed chain of links, and the numbers by which it is closed again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from asbuilt.arrays import Array, Indices, read_only
from asbuilt.description.rotation import find_rotation_fault
from asbuilt.description.structure.parts import Joint, ancestors
from asbuilt.errors import DescriptionError

LoopKind = Literal["connect", "weld", "joint"]
CONNECT, WELD, JOINT = range(3)
"""Kinds of loops: two points coincide, two frames do, a joint is at a polynomial of another."""
ROWS = (3, 6, 1)
"""Equations of a loop by kind."""
POINT = 0
TURN = 6
CURVE = 15
SIZE = 20
WIDTH = 21
"""Columns of the numbers of a loop: two points, a rotation, a polynomial, a length; their count."""
CODES = {"connect": CONNECT, "weld": WELD, "joint": JOINT}


@dataclass(frozen=True, eq=False)
class Loop:
    """Close a chain of links that the tree of links leaves open.

    `connect` holds a point of one link on a point of another, as a ball joint does; two of them on
    an axis are a hinge. `weld` holds their axes too: the axes of link b are turned by `rotation`
    (3, 3) in the axes of link a. `joint` holds a joint, the first of `joints`, at the polynomial
    `c_0 + c_1 x + ...` of the position x of the second, or at c_0 if there is none.

    `link_a`, `link_b` name links, frames or the root link; `point_a`, `point_b` (3,) are in their
    axes [m]. Raises `DescriptionError` for another kind and for numbers that do not fit.
    """

    kind: LoopKind
    link_a: str = ""
    point_a: Array = field(default_factory=lambda: np.zeros(3))
    link_b: str = ""
    point_b: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))
    joints: tuple[str, ...] = ()
    polynomial: tuple[float, ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        if self.kind not in get_args(LoopKind):
            raise DescriptionError(
                f"{self}: kind {self.kind!r} is not known; kinds are {', '.join(CODES)}"
            )
        for name, shape in (("point_a", (3,)), ("point_b", (3,)), ("rotation", (3, 3))):
            # Frozen, as kernels read these arrays in any thread.
            array = read_only(getattr(self, name))
            if array.shape != shape or not np.isfinite(array).all():
                raise DescriptionError(
                    f"{self}: {name} must be {shape} finite numbers, got {array.tolist()}"
                )
            object.__setattr__(self, name, array)
        object.__setattr__(self, "joints", tuple(self.joints))
        object.__setattr__(
            self, "polynomial", tuple(float(coefficient) for coefficient in self.polynomial)
        )
        fault = find_rotation_fault(self.rotation.tolist())
        of_joints = self.kind == "joint"
        numbers = 1 <= len(self.joints) <= 2 and 1 <= len(self.polynomial) <= 5
        if fault:
            raise DescriptionError(f"{self}: rotation is not a rotation matrix: {fault}")
        if of_joints and not numbers:
            raise DescriptionError(
                f"{self}: a loop of joints needs one or two of them and a polynomial of one to five"
                f" numbers, got {len(self.joints)} and {len(self.polynomial)}"
            )
        if not of_joints and not (self.link_a and self.link_b):
            raise DescriptionError(f"{self}: link_a and link_b are needed")
        if not of_joints and self.link_a == self.link_b:
            raise DescriptionError(
                f"{self}: both points are on {self.link_a!r}, so that it closes no chain; name the"
                " two links that meet there"
            )

    def __str__(self) -> str:
        if self.name:
            return f"loop {self.name!r}"
        ends = self.joints if self.kind == "joint" else (self.link_a, self.link_b)
        return f"loop of {' and '.join(ends) or 'no links'}"

    @property
    def ends(self) -> tuple[tuple[str, Array], tuple[str, Array]]:
        """Link and point of both sides."""
        return (self.link_a, self.point_a), (self.link_b, self.point_b)


@dataclass(frozen=True, eq=False)
class LoopNumbers:
    """Hold loops as the kernels take them; tree of n joints.

    `kinds` (n_loops,); `paths` (n_loops, 2, most): joints of the tree from the last link that both
    sides share to each point, -1 after the last, or the one joint of each side; `numbers` (n_loops,
    WIDTH) as `loop_equations` has them.
    """

    kinds: Indices
    paths: Indices
    numbers: Array

    @property
    def joints(self) -> list[int]:
        """Joints of the tree that some loop moves."""
        return sorted({int(joint) for joint in self.paths.ravel() if joint >= 0})


def number_loops(
    robot: str,
    loops: Sequence[Loop],
    tree: Sequence[Joint],
    places: Mapping[str, tuple[int, Array]],
) -> LoopNumbers:
    """Return loops by numbers for the joints of a tree.

    `places` has the link in the tree, `ROOT` for the root, and the pose in it by name. Raises
    `DescriptionError` where a link or a joint does not exist, or both sides of a loop are one link.
    """
    names = {joint.name: k for k, joint in enumerate(tree)} | {
        joint.name_in_tree: k for k, joint in enumerate(tree)
    }
    numbers = np.zeros((len(loops), WIDTH))
    paths: list[tuple[list[int], list[int]]] = []
    for loop, row in zip(loops, numbers, strict=True):
        # Loops of joints have no length.
        row[SIZE] = 1.0
        if loop.kind == "joint":
            for name in loop.joints:
                if name not in names:
                    raise _make_unknown_error(robot, loop, "joint", name, names)
            row[CURVE : CURVE + len(loop.polynomial)] = loop.polynomial
            paths.append(([names[loop.joints[0]]], [names[name] for name in loop.joints[1:]]))
            continue
        sides = []
        turns = []
        for side, (name, point) in enumerate(loop.ends):
            if name not in places:
                raise _make_unknown_error(robot, loop, "link", name, places)
            at, pose = places[name]
            row[POINT + 3 * side : POINT + 3 * side + 3] = pose[:3, :3] @ point + pose[:3, 3]
            sides.append(ancestors(tree, at))
            turns.append(pose[:3, :3])
        # Axes of b in a's link, through the poses of both names.
        row[TURN : TURN + 9] = (turns[0] @ loop.rotation @ turns[1].T).ravel()
        # Joints above both sides move the loop as a whole, and open nothing.
        shared = sum(1 for a, b in zip(*sides, strict=False) if a == b)
        ways = (sides[0][shared:], sides[1][shared:])
        if not any(ways):
            raise DescriptionError(
                f"{robot}: both sides of the {loop} are fixed to one link, so that it closes no"
                " chain; name the two links that meet there"
            )
        row[SIZE] = _measure_size(tree, ways, row) or 1.0
        paths.append(ways)
    # One rectangular array for all paths.
    most = max(len(way) for ways in paths for way in ways)
    array = np.full((len(loops), 2, most), -1, dtype=np.int64)
    for loop_paths, ways in zip(array, paths, strict=True):
        for side, way in enumerate(ways):
            loop_paths[side, : len(way)] = way
    kinds = np.array([CODES[loop.kind] for loop in loops], dtype=np.int64)
    for array_of in (kinds, array, numbers):
        array_of.setflags(write=False)
    return LoopNumbers(kinds, array, numbers)


def _measure_size(tree: Sequence[Joint], ways: tuple[list[int], list[int]], row: Array) -> float:
    """Return the length of a loop [m] that its placements and points add up to."""
    steps = [tree[k].before[:3, 3] for way in ways for k in way[1:]]
    steps += [tree[k].after[:3, 3] for way in ways for k in way]
    steps += [tree[way[0]].before[:3, 3] for way in ways if way]
    steps += [row[POINT : POINT + 3], row[POINT + 3 : POINT + 6]]
    return float(sum(np.linalg.norm(step) for step in steps))


def _make_unknown_error(
    robot: str, loop: Loop, what: str, name: str, known: Mapping[str, object]
) -> DescriptionError:
    return DescriptionError(
        f"{robot}: the {loop} names {what} {name!r}, which does not exist; known are"
        f" {', '.join(known)}",
        value=name,
        available=[*known],
    )
