"""Base parameters: the combinations of standard parameters that joint torques determine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.identifiability import (
    StandardParameter,
    classify_numerically,
    parameter_verdicts,
)
from asbuilt.dynamics.base.observation_rank import (
    ABSENT_COLUMN,
    RANK_TOLERANCE,
    ROWS_PER_COLUMN,
    ObservationRank,
    find_negligible_columns,
    observation_rank,
)
from asbuilt.dynamics.base.regrouping import (
    express_in_base_columns,
    regroup_structurally,
    regroup_symbolically,
)
from asbuilt.dynamics.base.regrouping_relations import reversed_echelon
from asbuilt.dynamics.base.symbols import Polynomial, Row, format_sum
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.kinematics import draw_postures
from asbuilt.dynamics.parameters import parameter_names, parameter_units
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.tables import Column, Table

SEED = 20152


SHOWN = 12
"""Base parameters that `repr` lists."""
KEPT = 48
"""Robots and drives whose base parameters are kept, for the logs of one robot."""


def regroup_numerically(model: RobotModel, drive: DriveSet) -> tuple[Indices, Array]:
    """Return the kept columns, counted from 0, and the matrix K with `Y = Y[:, columns] K`.

    The columns are the first independent ones of an observation matrix of random states, found from
    its null vectors read from the end, as in the structural regrouping. The structure of a tree
    does not have all of them: followers and passive joints move as no joint of a tree does.
    """
    drive = DriveSet(tuple(term.typical() for term in drive.terms))
    n = model.n_joints
    rng = np.random.default_rng(SEED)
    n_columns = 10 * model.n_links + drive.columns_per_joint * n
    samples = int(np.ceil(2.0 * ROWS_PER_COLUMN * n_columns / n))
    q = draw_postures(model, rng, samples)
    qd = rng.normal(scale=2.0, size=(samples, n))
    qdd = rng.normal(scale=4.0, size=(samples, n))
    Y = observation_matrix(model, q, qd, qdd, drive=drive)
    Y[:, find_negligible_columns(model)] = 0.0
    sizes = np.linalg.norm(Y, axis=0)
    absent = sizes <= ABSENT_COLUMN * sizes.max()
    scales = np.where(absent, 1.0, sizes)
    _, lengths, basis = np.linalg.svd(np.where(absent, 0.0, Y / scales), full_matrices=True)
    rank = int(np.sum(lengths > RANK_TOLERANCE * lengths[0]))
    echelon, dependent = reversed_echelon(basis[rank:])
    return express_in_base_columns(echelon, dependent, 1.0 / scales)


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Regroup the standard parameters chi into base parameters.

    `beta = regrouping @ chi`, `Y = Y[:, columns] @ regrouping`.

    `columns` (n_base,) are the first independent columns in id order, counted from 0, `ids =
    columns + 1`; `regrouping` has shape (n_base, n_standard). `expressions` have numbers for
    lengths, `symbolic` has symbols where the description names lengths. `link_joints` has for each
    link the joint, counted from 0, whose drive moves it relative to its parent. `standard` has a
    status of every standard parameter. Texts are derived when they are first read, by
    `symbolic_rows` and `classified`: most drive sets of a study are tried and never shown.
    """

    robot: str
    drive: DriveSet
    standard_names: tuple[str, ...]
    standard_units: tuple[str, ...]
    columns: Indices
    regrouping: Array
    link_joints: tuple[int, ...]
    symbolic_rows: Callable[[], list[Row]]
    classified: Callable[[], tuple[StandardParameter, ...]]

    def __post_init__(self) -> None:
        self.columns.setflags(write=False)
        self.regrouping.setflags(write=False)

    def __repr__(self) -> str:
        return f"BaseParameters\n{self._table().as_text()}"

    def _repr_html_(self) -> str:
        return self._table().as_html()

    def _table(self) -> Table:
        """Return one row per base parameter, the first `SHOWN` of them in short texts."""
        columns = (Column("id", align="right"), Column("expression", width=56), Column("unit"))
        rows = tuple(zip(self.ids.tolist(), self.symbolic, self.units, strict=True))
        title = (
            f"{self.robot}, drive terms {self.drive}: {self.n_base} base parameters of"
            f" {self.n_standard} standard ones"
        )
        return Table(columns, rows, title=title, important=tuple(range(min(SHOWN, self.n_base))))

    @cached_property
    def expressions(self) -> tuple[str, ...]:
        """Each base parameter as a sum of standard ones, in numbers."""
        return self._write_sums(_list_numbers(self.regrouping))

    @cached_property
    def symbolic(self) -> tuple[str, ...]:
        """Each base parameter as a sum of standard ones, with symbols for lengths."""
        return self._write_sums(self.symbolic_rows())

    @cached_property
    def standard(self) -> tuple[StandardParameter, ...]:
        """The status of every standard parameter, in id order."""
        return self.classified()

    def _write_sums(self, rows: Sequence[Row]) -> tuple[str, ...]:
        return tuple(
            _write_sum(row, column, self.standard_names)
            for row, column in zip(rows, self.columns, strict=True)
        )

    @property
    def n_standard(self) -> int:
        """Number of standard parameters."""
        return len(self.standard_names)

    @property
    def n_links(self) -> int:
        """Number of moving links, each with ten of the standard parameters, which come first."""
        return len(self.link_joints)

    @property
    def n_joints(self) -> int:
        """Number of joints, each with the same drive terms."""
        return max(self.link_joints) + 1

    @property
    def n_base(self) -> int:
        """Number of base parameters."""
        return len(self.columns)

    @property
    def ids(self) -> Indices:
        """Ids of the kept columns, counted from 1."""
        return self.columns + 1

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each base parameter: the standard parameter whose column is kept."""
        return tuple(self.standard_names[column] for column in self.columns)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each base parameter."""
        return tuple(self.standard_units[column] for column in self.columns)

    def values(self, chi: ArrayLike) -> Array:
        """Return `beta = regrouping @ chi`, shape (n_base,).

        A NaN in chi reaches only the base parameters that contain it.

        Raises `UsageError` for another shape than (n_standard,).
        """
        given = np.asarray(chi, dtype=np.float64)
        if given.shape != (self.n_standard,):
            raise UsageError(
                f"{self.robot} with drive terms {self.drive} has {self.n_standard} standard"
                f" parameters, got shape {given.shape}"
            )
        unknown = np.isnan(given)
        beta = self.regrouping @ np.where(unknown, 0.0, given)
        beta[(self.regrouping[:, unknown] != 0.0).any(axis=1)] = np.nan
        return beta


def find_base_parameters(model: RobotModel, drive: DriveSet = NO_DRIVE) -> BaseParameters:
    """Return the base parameters of a robot.

    Structure first, then checked against the numeric rank of a random observation matrix.

    Raises `IdentifiabilityError` where the two disagree. Sources: Mayeda, Yoshida & Osuka (1990);
    Gautier & Khalil (1990); Wensing, Niemeyer & Slotine (2024); derivation in
    docs/derivations/base-parameters.md.

    Examples
    --------
    >>> from asbuilt.description.formats.dh import DHRow, robot_from_dh
    >>> base = find_base_parameters(robot_from_dh([DHRow(a=0.5), DHRow(a=0.4)], name="planar"))
    >>> base.ids
    array([ 6, 16, 17, 18])
    >>> base.symbolic
    ('Izz1 + a1**2*(m1 + m2) + 2*a1*mx1', 'Izz2 - a2**2*m2', 'mx2 + a2*m2', 'my2')
    >>> base.standard[0].name, base.standard[0].status
    ('Ixx1', 'unidentifiable')
    """
    return _find_cached(model, drive)


@lru_cache(maxsize=KEPT)
def _find_cached(model: RobotModel, drive: DriveSet) -> BaseParameters:
    """Return the base parameters, remembered for the robots used last."""
    names = parameter_names(model, drive)
    by_numbers = model.tree is not model
    with use_one_blas_thread():
        if by_numbers:
            columns, matrix = regroup_numerically(model, drive)
            classified = partial(classify_numerically, model, columns, matrix, names)
            symbolic_rows = partial(_list_numbers, matrix)
        else:
            found = regroup_structurally(model, drive)
            columns = found.columns
            matrix = found.matrix
            classified = partial(parameter_verdicts, model, drive, found, names)
            symbolic_rows = partial(regroup_symbolically, model, drive, found)
        numeric = observation_rank(model, drive)
        if numeric.rank != len(columns):
            raise IdentifiabilityError(_describe_disagreement(model, drive, len(columns), numeric))
    return BaseParameters(
        robot=model.name,
        drive=drive,
        standard_names=names,
        standard_units=parameter_units(model, drive),
        columns=columns,
        regrouping=matrix,
        link_joints=model.link_joints,
        symbolic_rows=symbolic_rows,
        classified=classified,
    )


def _describe_disagreement(
    model: RobotModel, drive: DriveSet, structural: int, numeric: ObservationRank
) -> str:
    sizes = numeric.singular_values[
        max(0, min(structural, numeric.rank) - 1) : max(structural, numeric.rank) + 1
    ]
    return (
        f"{model.name} with drive terms {drive}: its structure gives {structural} base parameters,"
        f" but the numeric rank of a random observation matrix is {numeric.rank} (singular values"
        f" there, relative to the largest: {', '.join(f'{size:.1e}' for size in sizes)}). Most"
        " likely the description is almost, but not exactly, special: write angles near right"
        " angles and lengths near zero exactly"
        + ("; or two drive terms have the same effect" if len(drive.terms) > 1 else "")
    )


def _list_numbers(matrix: Array) -> list[Row]:
    """Return the rows of a regrouping as sums over standard parameters, in numbers."""
    return [{int(j): Polynomial.number(row[j]) for j in np.flatnonzero(row)} for row in matrix]


def _write_sum(row: Row, kept: int, names: tuple[str, ...]) -> str:
    return format_sum([(names[j], row[j]) for j in sorted(row, key=lambda j: (j != kept, j))])
