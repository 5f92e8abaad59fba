"""Base parameters: the combinations of standard parameters that joint torques determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.description.inertia import shift_matrix
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.parameters import parameter_names, parameter_units
from asbuilt.dynamics.transferable import (
    LENGTH_EXPONENTS,
    TransferableDirections,
    characteristic_length,
    reversed_echelon,
    transferable_directions,
)
from asbuilt.errors import IdentifiabilityError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class StandardParameter:
    """Say of one standard parameter whether torques determine it: `status` is identifiable, grouped or unidentifiable.

    `members` are the ids of the base parameters whose expressions contain it; `why` is one sentence.
    """

    id: int
    name: str
    status: str
    members: tuple[int, ...]
    why: str


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Regroup the standard parameters chi into base parameters: `beta = regrouping @ chi`, `Y = Y[:, columns] @ regrouping`.

    `columns` (n_base,) are the first independent columns in id order, counted from 0, `ids = columns + 1`; `regrouping` has shape
    (n_base, n_standard). `expressions` have numbers for lengths, `symbolic` letters where the description names lengths.
    """

    robot: str
    drive: DriveSet
    standard_names: tuple[str, ...]
    standard_units: tuple[str, ...]
    columns: Indices
    regrouping: Array
    expressions: tuple[str, ...]
    symbolic: tuple[str, ...]
    standard: tuple[StandardParameter, ...]

    def __post_init__(self) -> None:
        self.columns.setflags(write=False)
        self.regrouping.setflags(write=False)

    @property
    def n_standard(self) -> int:
        """Number of standard parameters."""
        return len(self.standard_names)

    @property
    def n_base(self) -> int:
        """Number of base parameters."""
        return len(self.columns)

    @property
    def ids(self) -> Indices:
        """Ids of the kept columns, counted from 1."""
        return self.columns + 1

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each base parameter: that of the standard parameter whose column is kept."""
        return tuple(self.standard_names[column] for column in self.columns)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each base parameter."""
        return tuple(self.standard_units[column] for column in self.columns)

    def values(self, chi: ArrayLike) -> Array:
        """Return `beta = regrouping @ chi`, shape (n_base,); a NaN in chi reaches only the base parameters that contain it."""
        given = np.asarray(chi, dtype=np.float64)
        if given.shape != (self.n_standard,):
            raise IdentifiabilityError(
                f"{self.robot} with drive terms {self.drive} has {self.n_standard} standard parameters, got shape {given.shape}"
            )
        unknown = np.isnan(given)
        beta = self.regrouping @ np.where(unknown, 0.0, given)
        beta[(self.regrouping[:, unknown] != 0.0).any(axis=1)] = np.nan
        return beta


def find_base_parameters(model: RobotModel, drive: DriveSet = NO_DRIVE) -> BaseParameters:
    """Return the base parameters of a robot: structure first, then checked against the numeric rank of a random observation matrix.

    Raises `IdentifiabilityError` where the two disagree. Sources: Mayeda, Yoshida & Osuka (1990); Gautier & Khalil (1990); Wensing,
    Niemeyer & Slotine (2024).
    """
    directions, _ = transferable_directions(model, armature="armature" in drive.keys, offset="offset" in drive.keys)
    null = _null_vectors(model, drive, directions)
    scale = _scales(model, drive)
    echelon, dependent = reversed_echelon(null)
    n_standard = null.shape[1]
    columns = np.setdiff1d(np.arange(n_standard), dependent)
    regrouping = np.zeros((len(columns), n_standard))
    regrouping[np.arange(len(columns)), columns] = 1.0
    regrouping[:, dependent] = -echelon[:, columns].T * scale[columns, None] / scale[dependent]
    regrouping = _rounded(regrouping)
    names = parameter_names(model, drive)
    units = parameter_units(model, drive)
    expressions = tuple(_expression(row, column, names) for row, column in zip(regrouping, columns, strict=True))
    return BaseParameters(
        robot=model.name,
        drive=drive,
        standard_names=names,
        standard_units=units,
        columns=columns,
        regrouping=regrouping,
        expressions=expressions,
        symbolic=expressions,
        standard=_standard(names, columns, regrouping),
    )


def _scales(model: RobotModel, drive: DriveSet) -> Array:
    """Return what one unit of each standard parameter is in lengths divided by the robot's size and forces by gravity."""
    size, strength = characteristic_length(model), float(np.linalg.norm(model.gravity))
    links = np.tile(size**LENGTH_EXPONENTS, model.n_joints)
    drives = np.ones((model.n_joints, drive.columns_per_joint))
    for i, joint in enumerate(model.joints):
        for j, letter in enumerate(drive.letters):
            if letter == "Ia" and joint.is_revolute:
                drives[i, j] = size**2
            if letter == "Fo" and strength > 0.0:
                drives[i, j] = strength
    return np.concatenate([links, drives.ravel()])


def _null_vectors(model: RobotModel, drive: DriveSet, directions: list[TransferableDirections]) -> Array:
    """Return the null vectors of the torques in scaled standard parameters, shape (n_null, n_standard)."""
    n, size = model.n_joints, characteristic_length(model)
    first_drive, per_joint = 10 * n, drive.columns_per_joint
    rows = []
    for found in directions:
        joint = model.joints[found.link]
        row = np.zeros((len(found.child), first_drive + per_joint * n))
        row[:, 10 * found.link : 10 * found.link + 10] = found.child @ shift_matrix(_inverse(joint.after, size)).T
        if joint.parent >= 0:
            row[:, 10 * joint.parent : 10 * joint.parent + 10] = -found.onto_parent @ shift_matrix(_scaled(joint.before, size)).T
        for letter, change in (("Ia", found.armature), ("Fo", found.offset)):
            if letter in drive.letters:
                row[:, first_drive + per_joint * found.link + drive.letters.index(letter)] = change
        rows.append(row)
    return np.vstack(rows)


def _scaled(placement: Array, size: float) -> Array:
    scaled = np.array(placement)
    scaled[:3, 3] /= size
    return scaled


def _inverse(placement: Array, size: float) -> Array:
    inverse = np.eye(4)
    inverse[:3, :3] = placement[:3, :3].T
    inverse[:3, 3] = -placement[:3, :3].T @ placement[:3, 3] / size
    return inverse


def _rounded(matrix: Array) -> Array:
    """Return `matrix` with every entry rounded to 14 significant digits, so that 0.16 is not 0.16000000000000003."""
    return np.array([[float(f"{value:.13e}") if value not in (0.0, 1.0, -1.0) else value for value in row] for row in matrix])


def _expression(row: Array, kept: int, names: tuple[str, ...]) -> str:
    text = names[kept]
    for column in np.flatnonzero(row):
        if column == kept:
            continue
        value = row[column]
        sign = "-" if value < 0 else "+"
        size = f"{abs(value):.10g}"
        text += f" {sign} {names[column]}" if size == "1" else f" {sign} {size}*{names[column]}"
    return text


def _standard(names: tuple[str, ...], columns: Indices, regrouping: Array) -> tuple[StandardParameter, ...]:
    found = []
    for j, name in enumerate(names):
        rows = np.flatnonzero(regrouping[:, j])
        members = tuple(int(columns[b]) + 1 for b in rows)
        alone = len(rows) == 1 and np.count_nonzero(regrouping[rows[0]]) == 1
        status = "unidentifiable" if not members else "identifiable" if alone else "grouped"
        found.append(StandardParameter(j + 1, name, status, members, ""))
    return tuple(found)
