"""Rotations with exact right angles, and rigid placements."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.errors import DescriptionError

QUARTER = math.pi / 2.0
EXACT_TOLERANCE = 1e-12
"""Angles [rad] this near a multiple of pi/2, and entries this near 0 or +-1, count as exact."""

READING_TOLERANCE = 1e-5
"""Angles [rad] that a file gives this near a multiple of pi/2 (1.5708, 1.571e0 is not) are taken as
that multiple.
"""

NOTED_CHANGE = 1e-9
"""A change of an angle [rad] beyond this is worth a note."""

ORTHOGONALITY = 1e-6
"""A matrix counts as a rotation where `R R^T` differs from 1 by no more: files write six digits."""

_STRAIGHTENED = "and taken as the right angle"
SCALED = "and is scaled to 1"
"""End of the note on an axis whose length is not 1."""
_QUARTER_COSINE = (1.0, 0.0, -1.0, 0.0)


def round_to_right_angle(angle: float) -> float:
    """Return the multiple of pi/2 nearest to `angle` [rad], or `angle` itself.

    The latter where none is within `READING_TOLERANCE`.

    >>> round_to_right_angle(1.5708) == math.pi / 2
    True
    >>> round_to_right_angle(1.57)
    1.57
    """
    nearest = round(angle / QUARTER) * QUARTER
    return nearest if abs(angle - nearest) <= READING_TOLERANCE else angle


def straighten_angle(angle: float, what: str, notes: list[str]) -> float:
    """Return `round_to_right_angle(angle)`, with a note if it differs by more than 1e-9 rad.

    The note names `what`.
    """
    exact = round_to_right_angle(angle)
    if abs(exact - angle) > NOTED_CHANGE:
        notes.append(f"{what} is given as {angle:.10g} rad {_STRAIGHTENED} {exact:.10g}")
    return exact


def condense_notes(notes: Sequence[str]) -> tuple[str, ...]:
    """Return the notes with what is said of several joints, and several angles, said once.

    >>> condense_notes(["joint 'a': no limits", "read", "joint 'b': no limits"])
    ("joints 'a', 'b': no limits", 'read')
    """
    said: dict[str, list[str]] = {}
    for note in notes:
        head, _, rest = note.partition(": ")
        of_joint = head.startswith("joint ") and rest
        said.setdefault(rest if of_joint else note, []).append(head if of_joint else "")
    whole = [_join_heads(heads, text) for text, heads in said.items()]
    angles = [note for note in whole if _STRAIGHTENED in note]
    if len(angles) <= 2:
        return tuple(whole)
    gathered = f"{angles[0]}; so are {len(angles) - 1} more angles of this description"
    return tuple(
        gathered if note is angles[0] else note
        for note in whole
        if note is angles[0] or _STRAIGHTENED not in note
    )


def _join_heads(heads: Sequence[str], text: str) -> str:
    """Return what is said of joints, each named by a head such as `joint 'j1'`."""
    if not heads[0]:
        return text
    names = ", ".join(head.removeprefix("joint ") for head in heads)
    return f"joint{'s' if len(heads) > 1 else ''} {names}: {text}"


def is_about_digits(note: str) -> bool:
    """Return whether a note tells of digits that a file lacks, which nobody needs to act upon."""
    return _STRAIGHTENED in note or note.endswith(SCALED)


def cosine_sine(angle: float) -> tuple[float, float]:
    """Return `(cos, sin)` of an angle [rad]; exact zeros and ones at multiples of pi/2."""
    quarters = round(angle / QUARTER)
    if abs(angle - quarters * QUARTER) <= EXACT_TOLERANCE:
        return _QUARTER_COSINE[quarters % 4], _QUARTER_COSINE[(quarters - 1) % 4]
    return math.cos(angle), math.sin(angle)


def rotation_x(angle: float) -> Array:
    """Return the 3 x 3 rotation about x by `angle` [rad]."""
    c, s = cosine_sine(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle: float) -> Array:
    """Return the 3 x 3 rotation about y by `angle` [rad]."""
    c, s = cosine_sine(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle: float) -> Array:
    """Return the 3 x 3 rotation about z by `angle` [rad]."""
    c, s = cosine_sine(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Return `Rz(yaw) Ry(pitch) Rx(roll)` for angles [rad] about the fixed axes, as in URDF."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    return snap_entries(rotation_z(yaw) @ rotation_y(pitch) @ rotation_x(roll))


def rpy_from_rotation(rotation: ArrayLike) -> Array:
    """Return roll, pitch, yaw [rad] with `rotation_from_rpy(rpy) = rotation`.

    Yaw is 0 where the pitch is +-pi/2.
    """
    R = np.asarray(rotation, dtype=np.float64)
    cosine = math.hypot(R[0, 0], R[1, 0])
    pitch = math.atan2(-R[2, 0], cosine)
    if cosine > EXACT_TOLERANCE:
        return np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])
    return np.array([math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0])


def rotation_from_quaternion(wxyz: ArrayLike) -> Array:
    """Return the rotation of a quaternion `w x y z`, which need not have unit length."""
    quaternion = np.asarray(wxyz, dtype=np.float64)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return snap_entries(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
    )


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Return the unit quaternion `w x y z` of a rotation, with its largest component positive.

    Each row of `4 q q^T`, read off the rotation matrix, is q times a component; the row of the
    largest is taken (Shepperd, 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64)
    rows = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    row = rows[int(np.argmax(np.diagonal(rows)))]
    return np.asarray(row / np.linalg.norm(row))


def rotation_onto(axis: ArrayLike) -> Array:
    """Return a rotation that carries z onto the unit vector `axis`.

    Exact for the six coordinate directions.
    """
    x, y, z = snap_entries(np.asarray(axis, dtype=np.float64))
    if math.hypot(x, y) == 0.0:
        return np.eye(3) if z > 0.0 else rotation_x(math.pi)
    return snap_entries(rotation_z(math.atan2(y, x)) @ rotation_y(math.atan2(math.hypot(x, y), z)))


def snap_entries(matrix: ArrayLike) -> Array:
    """Return `matrix` with entries within `EXACT_TOLERANCE` of 0, 1 or -1 made exact."""
    result = np.array(matrix, dtype=np.float64)
    nearest = np.rint(result)
    near = (np.abs(result - nearest) <= EXACT_TOLERANCE) & (np.abs(nearest) <= 1.0)
    result[near] = nearest[near] + 0.0
    return result


def find_rotation_fault(matrix: ArrayLike) -> str | None:
    """Return why a finite 3 x 3 matrix is no rotation, in numbers, or None where it is one."""
    R = np.asarray(matrix, dtype=np.float64)
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    determinant = float(np.linalg.det(R))
    if error <= ORTHOGONALITY and determinant > 0.0:
        return None
    return f"R R^T differs from 1 by {error:.2g} and det R = {determinant:.6g}"


def find_axes_across(vector: ArrayLike) -> Array:
    """Return two unit axes across a vector and each other, as rows (2, 3).

    They are as near to coordinate axes as may be: x and y across z, and across zero.
    """
    v = np.asarray(vector, dtype=np.float64)
    along = v / (np.linalg.norm(v) or 1.0)
    first, second = (
        axis - (axis @ along) * along
        for axis in np.eye(3)[np.sort(np.argsort(np.abs(along), kind="stable")[:2])]
    )
    first = first / np.linalg.norm(first)
    second = second - (second @ first) * first
    return np.array([first, second / np.linalg.norm(second)])


def check_placement(values: ArrayLike, what: str) -> Array:
    """Return a placement as a read-only 4 x 4 matrix of its own.

    Raises `DescriptionError`, naming `what` it is, where it is none.
    """
    T = read_only(values)
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        raise DescriptionError(
            f"{what} must be a finite 4 x 4 matrix, got shape {T.shape}: {T.tolist()}"
        )
    fault = find_rotation_fault(T[:3, :3])
    if fault:
        raise DescriptionError(
            f"{what} does not hold a rotation in its first three rows and columns: {fault}"
        )
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise DescriptionError(
            f"{what} must have the last row 0 0 0 1, got {T[3].tolist()}; translations stand in the"
            " last column"
        )
    return T


def placement(rotation: ArrayLike | None = None, translation: ArrayLike | None = None) -> Array:
    """Return the 4 x 4 matrix of a rotation followed by a translation [m].

    Either is the identity by default.
    """
    T = np.eye(4)
    if rotation is not None:
        T[:3, :3] = rotation
    if translation is not None:
        T[:3, 3] = translation
    return T


def straighten_placement(pose: Array, what: str, notes: list[str]) -> Array:
    """Return a pose with exact right angles where roll, pitch and yaw are near them, with notes."""
    rpy = rpy_from_rotation(pose[:3, :3]).tolist()
    exact = [
        straighten_angle(angle, f"{name} of {what}", notes)
        for name, angle in zip(("roll", "pitch", "yaw"), rpy, strict=True)
    ]
    return pose if exact == rpy else placement(rotation_from_rpy(exact), pose[:3, 3])


def compose_placements(*placements: Array) -> Array:
    """Return the product of placements with right angles kept exact."""
    T = np.eye(4)
    for factor in placements:
        T = T @ factor
        T[:3, :3] = snap_entries(T[:3, :3])
    return T


def invert_placement(T: Array) -> Array:
    """Return the inverse of a placement, `(R^T, -R^T p)`."""
    return placement(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])
