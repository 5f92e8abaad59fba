"""Transferable directions.

Changes of the parameters of one link that its parent link, or nothing at all, makes up for.

Derivation, symbols and sources: docs/derivations/base-parameters.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.inertia import shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import placement

RANK_TOLERANCE = 1e-10
"""A direction counts as absent where it is smaller than this, relative to the largest.

Lengths are divided by the robot's size first.
"""

_ARMATURE = 10
_OFFSET = 11
_SINE = 12
_COSINE = 13
_MUTUAL = slice(14, None)
_NOTHING = slice(0)
"""Places of the changes of a joint's drive, behind the ten parameters of its link."""

LENGTH_EXPONENTS = np.array([2.0] * 6 + [1.0] * 3 + [0.0])
"""Powers of length in the units of the ten inertial parameters."""

SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _build_translation_tensors() -> tuple[Array, Array]:
    def shift(t: Array) -> Array:
        return shift_matrix(placement(translation=t))

    unit = np.eye(3)
    linear = np.array([(shift(a) - shift(-a)) / 2.0 for a in unit])
    square = np.array(
        [[(shift(a + b) - shift(a) - shift(b) + np.eye(10)) / 2.0 for b in unit] for a in unit]
    )
    return linear, square


SHIFT_LINEAR, SHIFT_SQUARE = _build_translation_tensors()
"""Shift by t: `S(t) = 1 + sum_a t_a SHIFT_LINEAR[a] + sum_ab t_a t_b SHIFT_SQUARE[a, b]`, shapes
(3, 10, 10) and (3, 3, 10, 10).
"""


def _build_turn_harmonics() -> tuple[Array, Array]:
    angles = 2.0 * np.pi * np.arange(5) / 5.0
    turns = [
        np.array([[np.cos(q), -np.sin(q), 0.0], [np.sin(q), np.cos(q), 0.0], [0.0, 0.0, 1.0]])
        for q in angles
    ]
    fourier = np.linalg.inv(
        np.stack(
            [
                angles * 0 + 1,
                np.cos(angles),
                np.sin(angles),
                np.cos(2 * angles),
                np.sin(2 * angles),
            ],
            axis=1,
        )
    )
    shifts = np.einsum("ka,aij->kij", fourier, [shift_matrix(placement(turn)) for turn in turns])
    rotations = np.einsum("ka,aij->kij", fourier, turns)
    return np.round(8.0 * shifts) / 8.0, np.round(8.0 * rotations) / 8.0


TURN_SHIFTS, _TURN_ROTATIONS = _build_turn_harmonics()
"""Turning about z by q: `S(q) = sum_k TURN_SHIFTS[k] f_k(q)` with f = 1, cos q, sin q, cos 2q, sin
2q; shape (5, 10, 10).
"""

SLIDE_SHIFTS = np.stack([np.eye(10), SHIFT_LINEAR[2], SHIFT_SQUARE[2, 2]])
"""Sliding along z by q: `S(q) = sum_k SLIDE_SHIFTS[k] q^k`, shape (3, 10, 10)."""


def _build_cross(t: Array) -> Array:
    return np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])


def _build_twist_harmonics() -> tuple[Array, Array]:
    turn = np.zeros((3, 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = _TURN_ROTATIONS[:3].transpose(0, 2, 1)
    slide = np.stack([np.eye(6), np.zeros((6, 6))])
    slide[1, 3:, :3] = -_build_cross(np.array([0.0, 0.0, 1.0]))
    return turn, slide


TURN_TWISTS, SLIDE_TWISTS = _build_twist_harmonics()


def kinetic_functional(u: Array, w: Array) -> Array:
    """Return the symmetric bilinear form whose diagonal is the kinetic energy.

    `kinetic_functional(v, v) @ J = 1/2 v^T M(J) v`.

    Twists `(omega, v)` of shape (..., 6) at the frame origin, in frame axes; the answer has shape
    (..., 10).
    """
    angular = u[..., :3, None] * w[..., None, :3]
    angular = angular + angular.swapaxes(-1, -2)
    inertia = np.stack(
        [angular[..., i, j] / (4.0 if i == j else 2.0) for i, j in SYMMETRIC], axis=-1
    )
    moment = (np.cross(u[..., 3:], w[..., :3]) + np.cross(w[..., 3:], u[..., :3])) / 2.0
    mass = np.sum(u[..., 3:] * w[..., 3:], axis=-1, keepdims=True) / 2.0
    return np.concatenate([inertia, moment, mass], axis=-1)


def row_space(rows: Array) -> Array:
    """Return an orthonormal basis, as rows, of the span of `rows`.

    Near-zero rows are noise, not directions.
    """
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(basis[: _rank(sizes)])


def null_space(rows: Array) -> Array:
    """Return an orthonormal basis, as rows, of the vectors that every row annihilates."""
    _, sizes, basis = np.linalg.svd(rows, full_matrices=True)
    return np.asarray(basis[_rank(sizes) :])


def _rank(sizes: Array) -> int:
    """Return how many singular values are no noise."""
    return int(np.sum(sizes > RANK_TOLERANCE * sizes.max(initial=1.0)))


def reversed_echelon(rows: Array) -> tuple[Array, Indices]:
    """Return the reduced echelon form read from the last column, and the pivot columns.

    Row i is 1 at pivot i, 0 at and after other pivots.

    A column is a pivot exactly if it depends on the columns before it when `rows` span the null
    space of a matrix.
    """
    reduced = rows / np.abs(rows).max(axis=1, keepdims=True)
    pivots: list[int] = []
    for column in range(reduced.shape[1] - 1, -1, -1):
        used = len(pivots)
        if used == reduced.shape[0]:
            break
        candidates = np.abs(reduced[used:, column])
        best = used + int(candidates.argmax())
        if candidates[best - used] <= 10.0 * RANK_TOLERANCE:
            reduced[used:, column] = 0.0
            continue
        reduced[[used, best]] = reduced[[best, used]]
        reduced[used] /= reduced[used, column]
        factors = reduced[:, column].copy()
        factors[used] = 0.0
        hit = factors != 0.0
        reduced[hit] -= np.outer(factors[hit], reduced[used])
        reduced[hit, column] = 0.0
        pivots.append(column)
    reduced[np.abs(reduced) < RANK_TOLERANCE] = 0.0
    return reduced[: len(pivots)], np.array(pivots, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """What a link can do, in its joint frame.

    Spans of its twists (6,), kinetic functionals (10,) and gravity directions with a 1 (4,).

    `paced` spans, over all positions, the twists per unit speed of each joint, with a 1 for that
    joint behind them (6 + n,).
    """

    twists: Array
    kinetic: Array
    gravity: Array
    paced: Array


@dataclass(frozen=True, eq=False)
class RegroupingRelations:
    """Hold the k transferable directions of one link, in lengths divided by the robot's size.

    `child` (k, 10): change of the link's parameters in its joint frame (after the joint's motion);
    `onto_parent` (k, 10): what moves to the parent, in the joint frame before the motion (zero for
    children of the root link); `drive` (k, 4): changes of its drive, by columns `qdd`, 1, `sin q`
    and `cos q`, divided by the size of gravity but for the first, the armature; `mutual` (k, n):
    changes of mutual armatures, whose energy is `sum_i mutual_i qd_link qd_i`.
    """

    link: int
    child: Array
    onto_parent: Array
    drive: Array
    mutual: Array


def characteristic_length(model: RobotModel) -> float:
    """Return the power of two next to the largest offset between joints [m].

    1 if all are zero.
    """
    sizes = [
        np.abs(side[:3, 3]).max() for joint in model.joints for side in (joint.before, joint.after)
    ]
    largest = max(sizes)
    return float(2.0 ** np.round(np.log2(largest))) if largest > 0.0 else 1.0


def regrouping_relations(
    model: RobotModel, imitable: Mask
) -> tuple[list[RegroupingRelations], list[LinkMotion]]:
    """Return the regrouping relations of each link with its parent, and its motions.

    Changes of parameters along them leave all torques unchanged.

    With the last links first, these directions span the null space of the torques (Lagrangian
    argument in the derivation). `imitable` (n, 5) says which functions the drive of each joint has
    that links may imitate: the four of `RegroupingRelations.drive`, and mutual armatures.
    """
    n = model.n_joints
    size = characteristic_length(model)
    strength = float(np.linalg.norm(model.gravity))
    gravity = (
        np.append(model.gravity / strength, 1.0)
        if strength > 0.0
        else np.array([0.0, 0.0, 0.0, 1.0])
    )
    root = LinkMotion(
        np.zeros((0, 6)), np.zeros((0, 10)), row_space(gravity[None]), np.zeros((0, 6 + n))
    )
    motions: list[LinkMotion] = []
    directions: list[RegroupingRelations] = []
    for c, joint in enumerate(model.joints):
        if joint.parent < 0:
            parent = root
            fixed = joint.before
        else:
            parent = motions[joint.parent]
            fixed = model.joints[joint.parent].after @ joint.before
        motion, found = _carry_through_joint(
            parent, fixed[:3, :3], fixed[:3, 3] / size, joint.is_revolute, c, imitable[c]
        )
        motions.append(motion)
        shifts = TURN_SHIFTS if joint.is_revolute else SLIDE_SHIFTS
        onto_parent = (
            found[:, :10] @ shifts[0].T if joint.parent >= 0 else np.zeros((len(found), 10))
        )
        directions.append(
            RegroupingRelations(
                c,
                found[:, :10],
                onto_parent,
                found[:, 10:14],
                found[:, 14:],
            )
        )
    return directions, motions


def _carry_through_joint(
    parent: LinkMotion,
    rotation: Array,
    translation: Array,
    turns: bool,
    number: int,
    imitable: Mask,
) -> tuple[LinkMotion, Array]:
    """Carry what the parent can do through one joint.

    Return what the child can do and its directions (k, 14 + n): ten of the link, then the drive's.
    """
    to_joint = np.zeros((6, 6))
    to_joint[:3, :3] = to_joint[3:, 3:] = rotation.T
    to_joint[3:, :3] = -rotation.T @ _build_cross(translation)
    shift = shift_matrix(placement(rotation, translation))
    twists = parent.twists @ to_joint.T
    kinetic = parent.kinetic @ shift
    gravity = np.hstack([parent.gravity[:, :3] @ rotation, parent.gravity[:, 3:]])

    shifts, moves = (TURN_SHIFTS, TURN_TWISTS) if turns else (SLIDE_SHIFTS, SLIDE_TWISTS)
    axis = np.zeros(6)
    axis[2 if turns else 5] = 1.0
    moved = np.einsum("kij,vj->kvi", moves, twists).reshape(-1, 6)
    own = kinetic_functional(axis, axis)[None]
    carried = np.einsum("vi,kij->kvj", kinetic, shifts)
    on_moment = np.hstack(
        [np.zeros((len(gravity), 6)), gravity[:, :3], np.zeros((len(gravity), 1))]
    )
    weights = np.einsum("vi,kij->kvj", on_moment, shifts)
    n = parent.paced.shape[1] - 6
    paced = np.einsum("kij,vj->kvi", moves, parent.paced[:, :6] @ to_joint.T)
    beats = np.zeros((*paced.shape[:2], n))
    beats[0] = parent.paced[:, 6:]
    mutual_energy = kinetic_functional(paced, np.broadcast_to(axis, paced.shape)).reshape(-1, 10)

    blocks: list[Array] = []

    def demand(rows: Array, at: int | slice = _NOTHING, change: Array | float = 0.0) -> None:
        block = np.zeros((len(rows), 14 + n))
        block[:, :10] = rows
        block[:, at] = change
        blocks.append(block)

    demand(2.0 * own, _ARMATURE, 1.0)
    demand(2.0 * mutual_energy, _MUTUAL, beats.reshape(-1, n))
    demand(carried[1:].reshape(-1, 10))
    if turns:
        demand(weights[1], _SINE, gravity[:, 3])
        demand(weights[2], _COSINE, -gravity[:, 3])
        demand(weights[3:].reshape(-1, 10))
    else:
        demand(weights[1], _OFFSET, -gravity[:, 3])
        demand(weights[2])
    # a slide has constant weight, a turn one by sine and cosine
    of_drive = imitable[:4] & np.array([True, not turns, turns, turns])
    mutual = imitable[4] & (np.abs(parent.paced[:, 6:]).max(axis=0, initial=0.0) > 0.0)
    allowed = np.concatenate([np.ones(10, dtype=bool), of_drive, mutual])
    blocks.append(np.eye(14 + n)[~allowed])
    found, _ = reversed_echelon(null_space(np.vstack(blocks)))

    turned = np.einsum(
        "vi,kij->kvj", gravity[:, :3], _TURN_ROTATIONS[:3] if turns else np.eye(3)[None]
    )
    ones = np.zeros((*turned.shape[:2], 1))
    ones[0, :, 0] = gravity[:, 3]
    beat = np.zeros(6 + n)
    beat[:6] = axis
    beat[6 + number] = 1.0
    motion = LinkMotion(
        twists=row_space(np.vstack([moved, axis])),
        kinetic=row_space(
            np.vstack(
                [
                    carried.reshape(-1, 10),
                    kinetic_functional(moved, np.broadcast_to(axis, moved.shape)),
                    own,
                ]
            )
        ),
        gravity=row_space(np.concatenate([turned, ones], axis=2).reshape(-1, 4)),
        paced=row_space(
            np.vstack([np.concatenate([paced, beats], axis=2).reshape(-1, 6 + n), beat])
        ),
    )
    return motion, found
