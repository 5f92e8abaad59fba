"""Physical consistency of base parameters."""

from __future__ import annotations

import clarabel
import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification.bodies.cad_prior import (
    IDENTITY_SVEC,
    PSEUDO_INERTIA_SVEC,
    find_non_negative_columns,
)
from asbuilt.identification.bodies.cone_program import solve_cone_program

ROUNDING_OF_DRIVES = 1e-9
"""Negative friction or armature that is rounding: 1e-9 N m at unit velocity or acceleration."""


def consistency_margin(base: BaseParameters, beta: ArrayLike) -> float:
    """Return the largest t with `K chi = beta` and `P_i >= t 1` for every link.

    The pseudo-inertia `P = [[tr(I)/2 1 - I, m c], [m c^T, m]]` of a physically consistent link is
    positive semidefinite (Wensing, Kim & Slotine, IEEE RA-L 3, 2018), so a negative margin proves
    beta inconsistent. Armatures among the drive terms must be at least t too. Other drive
    parameters that share base parameters with these, such as the offset of a vertical slide, may
    have any value. A semidefinite program; infinite if nothing bounds t.

    Raises
    ------
    IdentifiabilityError
        If beta has another shape than (p,) or is not finite, or the solver fails.
    """
    values = np.asarray(beta, dtype=np.float64)
    if values.shape != (base.n_base,) or not np.all(np.isfinite(values)):
        raise IdentifiabilityError(
            f"{base.robot} needs {base.n_base} finite base parameters, got shape {values.shape}:"
            f" {values.tolist()}"
        )
    n_links = base.n_links
    counted = np.array(
        [j < 10 * n_links or name.startswith("Ia") for j, name in enumerate(base.standard_names)]
    )
    rows = np.flatnonzero(np.any(base.regrouping[:, counted] != 0, axis=1))
    shared = np.any(base.regrouping[rows] != 0, axis=0) & ~counted
    free = np.concatenate([np.flatnonzero(counted), np.flatnonzero(shared)])
    armatures = range(10 * n_links, int(counted.sum()))
    n = len(free)
    fixed = sparse.hstack(
        [sparse.csc_matrix(base.regrouping[np.ix_(rows, free)]), sparse.csc_matrix((len(rows), 1))]
    )
    positive = sparse.hstack(
        [
            -sparse.eye_array(len(armatures), n, k=10 * n_links),
            sparse.csc_matrix(np.ones((len(armatures), 1))),
        ]
    )
    bodies = sparse.hstack(
        [
            sparse.kron(sparse.eye_array(n_links), sparse.csc_matrix(-PSEUDO_INERTIA_SVEC)),
            sparse.csc_matrix((10 * n_links, n - 10 * n_links)),
            sparse.csc_matrix(np.tile(IDENTITY_SVEC, n_links)[:, None]),
        ]
    )
    constraints = sparse.csc_matrix(sparse.vstack([fixed, positive, bodies]))
    bounds = np.concatenate([values[rows], np.zeros(len(armatures) + 10 * n_links)])
    cones = [
        clarabel.ZeroConeT(len(rows)),
        clarabel.NonnegativeConeT(len(armatures)),
        *[clarabel.PSDTriangleConeT(4)] * n_links,
    ]
    goal = np.append(np.zeros(n), -1.0)
    solution = solve_cone_program(
        sparse.csc_matrix((n + 1, n + 1)), goal, constraints, bounds, cones
    )
    if "DualInfeasible" in solution.status:
        return float("inf")
    if not solution.is_solved:
        raise IdentifiabilityError(
            f"the physical consistency of the base parameters of {base.robot} is undecided (solver"
            f" status {solution.status})"
        )
    return float(solution.x[-1])


def margin_is_consistent(margin: float, beta: ArrayLike) -> bool:
    """Return whether a margin is non-negative up to the solver's rounding."""
    scale = max(1.0, float(np.max(np.abs(np.asarray(beta, dtype=np.float64)), initial=0.0)))
    # Negative margin, in units of the largest parameter, that is rounding of the solver.
    return margin >= -1e-8 * scale


def non_passive_drives(base: BaseParameters, beta: ArrayLike) -> tuple[str, ...]:
    """Return the names of single drive parameters that are negative, against passivity."""
    values = np.asarray(beta, dtype=np.float64)
    alone = (np.count_nonzero(base.regrouping, axis=1) == 1) & np.isin(
        base.columns, find_non_negative_columns(base.n_links, base.n_joints, base.drive)
    )
    return tuple(base.names[j] for j in np.flatnonzero(alone & (values < -ROUNDING_OF_DRIVES)))
