"""The regrouping of standard into base parameters where others move joints: by numbers."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.observation_rank import (
    ABSENT_COLUMN,
    RANK_TOLERANCE,
    ROWS_PER_COLUMN,
    negligible_columns,
)
from asbuilt.dynamics.base.regrouping import without_noise
from asbuilt.dynamics.base.regrouping_relations import reversed_echelon
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.kinematics import random_postures
from asbuilt.dynamics.regressor import observation_matrix

SEED = 20152


def numeric_regrouping(model: RobotModel, drive: DriveSet) -> tuple[Indices, Array]:
    """Return the kept columns, counted from 0, and the matrix K with `Y = Y[:, columns] K`.

    The columns are the first independent ones of an observation matrix of random states, found from
    its null vectors read from the end, as in the structural regrouping. The structure of a tree
    does not have all of them: followers and passive joints move as no joint of a tree does.
    """
    drive = DriveSet(tuple(term.typical() for term in drive.terms))
    n, rng = model.n_joints, np.random.default_rng(SEED)
    n_columns = 10 * model.n_links + drive.columns_per_joint * n
    samples = int(np.ceil(2.0 * ROWS_PER_COLUMN * n_columns / n))
    q = random_postures(model, rng, samples)
    qd, qdd = rng.normal(scale=2.0, size=(samples, n)), rng.normal(scale=4.0, size=(samples, n))
    Y = observation_matrix(model, q, qd, qdd, drive=drive)
    Y[:, negligible_columns(model)] = 0.0
    sizes = np.linalg.norm(Y, axis=0)
    absent = sizes <= ABSENT_COLUMN * sizes.max()
    scales = np.where(absent, 1.0, sizes)
    _, lengths, basis = np.linalg.svd(np.where(absent, 0.0, Y / scales), full_matrices=True)
    rank = int(np.sum(lengths > RANK_TOLERANCE * lengths[0]))
    echelon, dependent = reversed_echelon(basis[rank:])
    columns = np.setdiff1d(np.arange(n_columns), dependent)
    matrix = np.zeros((len(columns), n_columns))
    matrix[np.arange(len(columns)), columns] = 1.0
    matrix[:, dependent] = -echelon[:, columns].T * scales[dependent] / scales[columns, None]
    for b, j in zip(*np.nonzero(matrix), strict=True):
        matrix[b, j] = without_noise(matrix[b, j])
    return columns, matrix
