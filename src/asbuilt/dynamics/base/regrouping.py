"""The regrouping of standard into base parameters, as the structure of a robot dictates it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.description.inertia import shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import invert_placement, placement
from asbuilt.dynamics.base.observation_rank import find_negligible_columns
from asbuilt.dynamics.base.regrouping_relations import (
    LENGTH_EXPONENTS,
    LinkMotion,
    RegroupingRelations,
    characteristic_length,
    null_space,
    regrouping_relations,
    reversed_echelon,
)
from asbuilt.dynamics.base.symbols import (
    Polynomial,
    Row,
    express_dependent_columns,
    null_rows,
    replace_lengths,
    slide_joint_frames,
)
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.parameters import parameter_count

DRIVES_KEPT = 8
"""Robots and kinds of drives whose relations are remembered: a study tries a dozen sets of terms of
two or three kinds."""
IMITABLE = ("qdd", "1", "sin(q)", "cos(q)")
"""Elementary functions that links can imitate, in the order of the changes of
`RegroupingRelations`.
"""


@dataclass(frozen=True, eq=False)
class DriveStructure:
    """Hold, for a robot of n joints with drives of m columns each, all columns scaled.

    `ways[k, f]` (m,) are the columns of joint k that make up the elementary function f of
    `IMITABLE`, zero where `able[k, f]` is False; `redundant` (r, n m) are sums of drive columns
    that are zero at all times; `motor_columns` (n, m) says which columns are armatures of motors
    that several joints turn; `shares` (n, n) are the robot's `motor_shares`, scaled.
    """

    ways: Array
    able: Mask
    redundant: Array
    motor_columns: Mask
    shares: Array

    @property
    def imitable(self) -> Mask:
        """What the drive of each joint has that links may imitate (n, 5), mutual armatures last."""
        mutual = np.full(len(self.able), self.motor_columns.any())
        return np.column_stack([self.able[:, 0] | mutual, self.able[:, 1:], mutual])


def decompose_drive(model: RobotModel, drive: DriveSet, unit: Array) -> DriveStructure:
    """Take the columns of a drive apart into elementary functions.

    `unit` (n,) is one unit of each joint coordinate in scaled lengths.
    """
    n = model.n_joints
    m = drive.columns_per_joint
    drive.check_joints(n)
    ways = np.zeros((n, 4, m))
    able = np.zeros((n, 4), dtype=bool)
    redundant = []
    shares = model.motor_shares * unit[None, :] / unit[:, None]
    coupled = np.abs(shares).max(axis=1) > 0.0
    of_motor = drive.of_motor
    armature_of_motor = np.array(
        [term.key == "motor_armature" for term in drive.terms for _ in term.symbols], dtype=bool
    )
    for k in range(n):
        functions = drive.functions(k)
        known = list(
            dict.fromkeys([*IMITABLE, *(name for function in functions for name in function)])
        )
        matrix = np.zeros((len(known), m))
        for column, function in enumerate(functions):
            for name, factor in function.items():
                matrix[known.index(name), column] = (
                    0.0 if of_motor[column] and not coupled[k] else factor
                )
        for f in range(4):
            wanted = np.zeros(len(known))
            wanted[f] = 1.0
            way, *_ = np.linalg.lstsq(matrix, wanted, rcond=None) if m else (np.zeros(0),)
            able[k, f] = bool(m) and float(np.abs(matrix @ way - wanted).max()) < 1e-12
            ways[k, f] = np.where(np.abs(way) < 1e-14, 0.0, way) if able[k, f] else 0.0
        for row in reversed_echelon(null_space(matrix))[0] if m else ():
            placed = np.zeros((n, m))
            placed[k] = row
            redundant.append(placed.ravel())
    return DriveStructure(
        ways,
        able,
        np.array(redundant).reshape(len(redundant), n * m),
        armature_of_motor[None, :] & coupled[:, None],
        shares,
    )


def find_realisable_sums(
    directions: Sequence[RegroupingRelations], structure: DriveStructure
) -> tuple[Array, Array, Array]:
    """Return which sums of all directions the armatures at hand can make.

    (r, k) sums, with the armature changes of joints (r, n) and motors (r, n).

    A mutual armature of joints i and j exists only as a part of a motor's that both turn: `Q =
    diag(Ia) + sum_m Iam_m T_m T_m^T`.
    """
    n = len(structure.shares)
    armature = np.concatenate([found.drive[:, 0] for found in directions])
    mutual = np.vstack([found.mutual for found in directions])
    link = np.concatenate([np.full(len(found.child), found.link) for found in directions])
    k = len(link)
    motors = np.flatnonzero(structure.motor_columns.any(axis=1))
    conditions = np.zeros((n, n, k + len(motors)))
    for d in range(k):
        conditions[link[d], link[d], d] = armature[d]
        conditions[link[d], :, d] += mutual[d]
        conditions[:, link[d], d] += mutual[d]
    for column, motor in enumerate(motors, start=k):
        conditions[:, :, column] = -np.outer(structure.shares[motor], structure.shares[motor])
    free = np.zeros((n, n), dtype=bool)
    np.fill_diagonal(free, structure.able[:, 0])
    solutions, _ = reversed_echelon(null_space(conditions[np.triu(~free)]))
    of_motors = np.zeros((len(solutions), n))
    of_motors[:, motors] = solutions[:, k:]
    diagonal = np.einsum("iik,rk->ri", conditions, solutions)
    return solutions[:, :k], np.where(structure.able[:, 0], diagonal, 0.0), of_motors


AXIAL = np.array(
    [
        [0, 0, 0, 0, 0, 0, 0, 0, 0, 1],
        [0, 0, 0, 0, 0, 0, 0, 0, 1, 0],
        [1, 0, 0, 1, 0, 0, 0, 0, 0, 0],
    ],
    dtype=np.float64,
)
"""A mass on the z axis, a first moment along it, and `Ixx = Iyy`.

What a turn about z leaves as it is.
"""

LETTER_TOLERANCE = 1e-9
"""A factor in symbols must equal the number it stands for to this, relative to the largest factor
in its row.
"""


@dataclass(frozen=True, eq=False)
class Regrouping:
    """Hold the kept columns and the matrix with `Y = Y[:, columns] @ matrix`.

    `columns` (n_base,) count from 0; `matrix` is (n_base, n_standard).

    What it follows from: `model`, the robot with its joint frames at `slide_joint_frames`;
    `directions` and `motions` of its links in these frames; `null_blocks`, per link its directions
    over all standard parameters (k, n_standard); `axial_blocks` (3, 10), per link a mass on the
    joint's axis, a first moment along it, and equal inertias across it, in the link frame. Lengths
    are divided by `size` in all of these. `structure` is what the drive columns have in common with
    each other and with links.
    """

    columns: Indices
    matrix: Array
    directions: tuple[RegroupingRelations, ...]
    motions: tuple[LinkMotion, ...]
    null_blocks: tuple[Array, ...]
    axial_blocks: tuple[Array, ...]
    size: float
    model: RobotModel
    structure: DriveStructure


def regroup_structurally(model: RobotModel, drive: DriveSet) -> Regrouping:
    """Return the regrouping by exact structure.

    Columns that depend on earlier ones are the pivots of the null vectors read from the end.
    """
    model = slide_joint_frames(model)
    size = characteristic_length(model)
    structure = decompose_drive(
        model, drive, np.array([1.0 if joint.is_revolute else size for joint in model.joints])
    )
    directions, motions = _relate_links(model, structure.imitable.tobytes())
    to_link = _shift_to_links(model)
    scales = _choose_scales(model, drive)
    blocks = _build_null_blocks(model, drive, directions, to_link, structure, scales)
    redundant = (
        np.hstack([np.zeros((len(structure.redundant), 10 * model.n_links)), structure.redundant])
        / scales
    )
    null = np.vstack(
        [*_realise_null_vectors(model, drive, directions, blocks, structure), redundant]
    )
    echelon, dependent = reversed_echelon(
        _complete_null_vectors(find_negligible_columns(model), null)
    )
    columns, matrix = express_in_base_columns(echelon, dependent, scales)
    return Regrouping(
        columns=columns,
        matrix=matrix,
        directions=directions,
        motions=motions,
        null_blocks=tuple(blocks),
        axial_blocks=tuple(AXIAL @ shift.T for shift in to_link),
        size=size,
        model=model,
        structure=structure,
    )


@lru_cache(maxsize=DRIVES_KEPT)
def _shift_to_links(model: RobotModel) -> tuple[Array, ...]:
    """Return how parameters change from the frame of each joint to that of its link, (10, 10)."""
    size = characteristic_length(model)
    placements = [invert_placement(_scale_translation(joint.after, size)) for joint in model.joints]
    return tuple(map(shift_matrix, placements))


@lru_cache(maxsize=DRIVES_KEPT)
def _relate_links(
    model: RobotModel, imitable: bytes
) -> tuple[tuple[RegroupingRelations, ...], tuple[LinkMotion, ...]]:
    """Return the relations of links, remembered: most drives let links imitate the same."""
    flags = np.frombuffer(imitable, dtype=bool).reshape(model.n_joints, -1)
    directions, motions = regrouping_relations(model, flags)
    return tuple(directions), tuple(motions)


def regroup_symbolically(model: RobotModel, drive: DriveSet, found: Regrouping) -> list[Row]:
    """Return the rows of the regrouping with symbols for lengths, as sums over standard parameters.

    Each row is checked against numbers, for the robot itself and for one of the same build with
    other lengths; a row that fails - its factors are no polynomials, or only right for these
    lengths - keeps its numbers.
    """
    n_standard = found.matrix.shape[1]
    numbers: list[Row] = [
        {int(j): Polynomial.number(float(row[j])) for j in np.flatnonzero(row)}
        for row in found.matrix
    ]
    bare = any(link.negligible for link in model.links)
    if bare or not model.lengths or found.structure.motor_columns.any():
        return numbers
    pivots = np.setdiff1d(np.arange(n_standard), found.columns)
    combined = express_dependent_columns(
        _derive_symbolic_null_rows(model, found), [int(pivot) for pivot in pivots]
    )
    if combined is None:
        return numbers
    rows: dict[int, Row] = {
        int(column): {int(column): Polynomial.number(1.0)} for column in found.columns
    }
    for j, members in combined.items():
        for b, factor in members.items():
            rows[b][j] = factor
    other = {
        symbol: value * (1.2 + 0.3 * np.sin(k + 1.0))
        for k, (symbol, value) in enumerate(model.lengths.items())
    }
    elsewhere = regroup_structurally(replace_lengths(found.model, other), drive)
    if not np.array_equal(elsewhere.columns, found.columns):
        return numbers
    checks = ((found.matrix, model.lengths), (elsewhere.matrix, other))
    return [
        (
            symbolic
            if all(_agrees(symbolic, matrix[b], lengths) for matrix, lengths in checks)
            else numbers[b]
        )
        for b, symbolic in enumerate(dict(sorted(row.items())) for row in rows.values())
    ]


def _agrees(symbolic: Row, row: Array, lengths: Mapping[str, float]) -> bool:
    values = np.zeros(len(row))
    for j, factor in symbolic.items():
        values[j] = factor.value(lengths)
    return bool(np.abs(values - row).max() <= LETTER_TOLERANCE * np.abs(row).max())


def express_in_base_columns(
    echelon: Array, dependent: Indices, scales: Array
) -> tuple[Indices, Array]:
    """Return the independent columns and the matrix K with `Y = Y[:, columns] K`.

    `echelon` are null vectors of Y read from the end, with pivots at the `dependent` columns, in
    units `scales` of each column. Factors have 15 significant digits: 0.16 for 0.16000000000000003.
    """
    columns = np.setdiff1d(np.arange(len(scales)), dependent)
    matrix = np.zeros((len(columns), len(scales)))
    matrix[np.arange(len(columns)), columns] = 1.0
    matrix[:, dependent] = -echelon[:, columns].T * scales[columns, None] / scales[dependent]
    for b, j in zip(*np.nonzero(matrix), strict=True):
        matrix[b, j] = float(f"{matrix[b, j]:.14e}")
    return columns, matrix


def _derive_symbolic_null_rows(model: RobotModel, found: Regrouping) -> list[Row]:
    """Return the null vectors with symbols for lengths, in physical units."""
    first = 10 * model.n_links
    strength = float(np.linalg.norm(model.gravity))
    ways = found.structure.ways
    per = ways.shape[2]
    units = np.array(
        [_choose_function_units(joint.is_revolute, found.size, strength) for joint in model.joints]
    )
    rows = null_rows(found.model, found.directions)
    changes = [
        direction.drive * units[direction.link] @ ways[direction.link]
        for direction in found.directions
    ]
    links = [direction.link for direction in found.directions for _ in range(len(direction.child))]
    for row, link, change in zip(rows, links, np.vstack(changes), strict=True):
        row |= {
            first + per * link + int(c): Polynomial.number(float(change[c]))
            for c in np.flatnonzero(change)
        }
    return rows + [
        {first + int(c): Polynomial.number(float(redundant[c])) for c in np.flatnonzero(redundant)}
        for redundant in found.structure.redundant
    ]


def _choose_function_units(
    revolute: bool, size: float, strength: float
) -> tuple[float, float, float, float]:
    """Return one unit of the changes of armature, offset, sine and cosine.

    In lengths divided by the size of the robot and forces divided by gravity.
    """
    force = strength if strength > 0.0 else 1.0
    return (size**2, force, force * size, force * size) if revolute else (1.0, force, 1.0, 1.0)


def _choose_scales(model: RobotModel, drive: DriveSet) -> Array:
    """Return one unit of the column of each standard parameter.

    In lengths divided by the size of the robot and forces divided by gravity.
    """
    size = characteristic_length(model)
    strength = float(np.linalg.norm(model.gravity))
    scales = [np.tile(size**LENGTH_EXPONENTS, model.n_joints)]
    for k, joint in enumerate(model.joints):
        units = dict(
            zip(IMITABLE, _choose_function_units(joint.is_revolute, size, strength), strict=True)
        )
        kinds = [term.key for term in drive.terms for _ in term.symbols]
        for kind, function in zip(kinds, drive.functions(k), strict=True):
            own = next((units[name] for name in IMITABLE if name in function), 1.0)
            scales.append(np.array([units["qdd"] if kind == "motor_armature" else own]))
    return np.concatenate(scales)


def _build_null_blocks(
    model: RobotModel,
    drive: DriveSet,
    directions: Sequence[RegroupingRelations],
    to_link: Sequence[Array],
    structure: DriveStructure,
    scales: Array,
) -> list[Array]:
    """Return the directions of each link over standard parameters in units of `scales`.

    Shapes (k, n_standard); mutual armatures are left out.
    """
    size = characteristic_length(model)
    per = drive.columns_per_joint
    first = 10 * model.n_links
    blocks = []
    for found, shift in zip(directions, to_link, strict=True):
        joint = model.joints[found.link]
        block = np.zeros((len(found.child), parameter_count(model, drive)))
        block[:, 10 * found.link : 10 * found.link + 10] = found.child @ shift.T
        if joint.parent >= 0:
            block[:, 10 * joint.parent : 10 * joint.parent + 10] = (
                -found.onto_parent @ shift_matrix(_scale_translation(joint.before, size)).T
            )
        own = slice(first + per * found.link, first + per * (found.link + 1))
        units = np.array(
            _choose_function_units(joint.is_revolute, size, float(np.linalg.norm(model.gravity)))
        )
        block[:, own] = (found.drive * units @ structure.ways[found.link]) / scales[own]
        blocks.append(block)
    return blocks


def _realise_null_vectors(
    model: RobotModel,
    drive: DriveSet,
    directions: Sequence[RegroupingRelations],
    blocks: Sequence[Array],
    structure: DriveStructure,
) -> list[Array]:
    """Return the null vectors of the torques.

    The directions themselves, or such sums of them that the motors' armatures can take part in.
    """
    if not structure.motor_columns.any():
        return list(blocks)
    per = drive.columns_per_joint
    first = 10 * model.n_links
    sums, of_joints, of_motors = find_realisable_sums(directions, structure)
    rows = sums @ np.vstack(blocks)
    armature = structure.ways[:, 0, :]
    for found in directions:
        own = slice(first + per * found.link, first + per * (found.link + 1))
        taken = np.concatenate(
            [direction.drive[:, 0] * (direction.link == found.link) for direction in directions]
        )
        rows[:, own] += (of_joints[:, found.link] - sums @ taken)[:, None] * armature[found.link]
        rows[:, own] += of_motors[:, found.link, None] * structure.motor_columns[found.link]
    return [rows]


def _complete_null_vectors(columns: Sequence[int], null: Array) -> Array:
    """Return the null vectors of a matrix of which some columns are zero.

    They have no part in these columns, and one more vector is there for each of these.
    """
    gone = np.zeros((len(columns), null.shape[1]))
    gone[np.arange(len(columns)), columns] = 1.0
    kept = null_space(null[:, columns].T) @ null
    kept[:, columns] = 0.0
    return np.vstack([kept, gone])


def _scale_translation(transform: Array, size: float) -> Array:
    return placement(transform[:3, :3], transform[:3, 3] / size)
