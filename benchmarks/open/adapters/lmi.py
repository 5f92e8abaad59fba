"""Fit with linear matrix inequalities: every link keeps a positive pseudo-inertia.

The form of Sousa and Cortesao (Int. J. Robotics Research 33, 2014) with the regularisation and its
weight of Khorshidi et al. (arXiv 2409.09850): half of the mean squared torque error, rows weighted
by joint, plus 1e-4 of the pullback of the Riemannian distance from the description. Friction and
rotors are not negative. Their bounding ellipsoids and total mass are no facts of a task.
"""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
import pinocchio as pin
from adapter import Facts, Fit
from flyer import Flyer, described
from loops import regression_of
from pinocchio_regressor import FROM_PINOCCHIO
from regression import Regression

PACKAGE = "cvxpy"
REQUIRES = ["cvxpy>=1.5", "clarabel", "pin>=3.4", "scipy"]
TITLE = "linear matrix inequalities, cvxpy and Clarabel"
ADDRESS = "https://github.com/ShahramKhorshidi/system_identification"
WEIGHT = 1e-4


def fit(facts: Facts) -> Fit:
    """Identify consistent links."""
    model = pin.buildModelFromUrdf(facts.urdf)
    joints = [model.getJointId(name) for name in facts.tree_joints]
    cad = np.array([model.inertias[j].toDynamicParameters()[FROM_PINOCCHIO] for j in joints])
    return consistent_fit(regression_of(facts), cad)


def fit_legs(facts: Facts) -> Fit:
    """Identify consistent links of a robot with a free base."""
    return consistent_fit(Flyer(facts), described(facts))


def consistent_fit(regression: Regression, cad: Any) -> Fit:
    """Return the consistent links (n, 10) that fit best near those of the description."""
    if not np.any(cad):
        raise NotImplementedError("its distance is one from masses, which the description lacks")
    W, tau = regression.stacked(regression.facts.plain())
    w = regression.weights(W, tau)
    R = np.linalg.qr(np.column_stack([W * w[:, None], tau * w]), mode="r")
    x = cp.Variable(W.shape[1])
    constraints, distance = [], 0.0
    for k, prior in enumerate(cad):
        link = x[10 * k : 10 * k + 10]
        constraints.append(pseudo(link) >> 0)
        root = np.linalg.cholesky(pullback(prior)).T
        distance += 0.5 * cp.sum_squares(root @ (link - prior))
    for j, name in enumerate(regression.names):
        if name.startswith(("Fv", "Fc", "Ia")):
            constraints.append(x[j] >= 0.0)
    error = 0.5 * cp.sum_squares(R[:, :-1] @ x - R[:, -1]) / len(tau)
    cp.Problem(cp.Minimize(error + WEIGHT * distance), constraints).solve(solver=cp.CLARABEL)
    if x.value is None:
        raise RuntimeError("the solver found no solution")
    values = np.array(x.value)
    links = values[: 10 * len(cad)].reshape(-1, 10)
    return Fit(lambda motion: regression.torque(motion, values), links=links, note="no std errors")


def pseudo(link: Any) -> Any:
    """Return the pseudo-inertia (4, 4) of parameters `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m`."""
    Ixx, Ixy, Ixz, Iyy, Iyz, Izz, mx, my, mz, m = (link[i] for i in range(10))
    half = 0.5 * (Ixx + Iyy + Izz)
    rows = [
        [half - Ixx, -Ixy, -Ixz, mx],
        [-Ixy, half - Iyy, -Iyz, my],
        [-Ixz, -Iyz, half - Izz, mz],
        [mx, my, mz, m],
    ]
    if isinstance(link, np.ndarray):
        return np.array(rows)
    return cp.bmat([[cp.reshape(each, (1, 1), order="C") for each in row] for row in rows])


def pullback(prior: Any) -> Any:
    """Return the metric (10, 10) of the pseudo-inertias at a link: `tr(P^-1 V_i P^-1 V_j)`."""
    P = pseudo(prior)
    P = P + 1e-6 * np.trace(P) * np.eye(4)
    values, axes = np.linalg.eigh(P)
    if values[0] <= 0.0:  # bodies that cannot exist: the nearest that can
        P = axes @ np.diag(np.maximum(values, 1e-6 * np.trace(P))) @ axes.T
    basis = [np.linalg.solve(P, pseudo(row)) for row in np.eye(10)]
    M = np.array([[np.trace(a @ b) for b in basis] for a in basis])
    return 0.5 * (M + M.T) + 1e-9 * np.trace(M) * np.eye(10)
