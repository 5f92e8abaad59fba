"""adam: regressor by CasADi's derivative of its inverse dynamics, then weighted least squares."""

from __future__ import annotations

from typing import Any

import casadi as cs
import numpy as np
from adam.casadi import KinDynComputations
from adam.casadi.casadi_like import CasadiLike
from adapter import Estimate, Facts, Fit
from regression import Regression

PACKAGE = "adam-robotics"
REQUIRES = ["adam-robotics[casadi]", "scipy"]
TITLE = "adam"
ADDRESS = "https://github.com/ami-iit/adam"


def fit(facts: Facts) -> Fit:
    """Identify base parameters."""
    return Regression(facts, tree_regressor(facts)).weighted_fit()


def payload(facts: Facts) -> list[Estimate]:
    """Weigh what the last link carries."""
    return [Regression(facts, tree_regressor(facts)).payload()]


def weights(facts: Facts) -> list[Estimate]:
    """Return the first moments of what a body carries, log by log."""
    return Regression(facts, tree_regressor(facts)).moments()


def tree_regressor(facts: Facts) -> Any:
    """Return the derivative of `M(q) qdd + h(q, qd)` by the inertial parameters of the links."""
    gravity = np.array([*facts.gravity, 0.0, 0.0, 0.0])
    robot = KinDynComputations(facts.urdf, facts.tree_joints, gravity=gravity)
    algorithms, n = robot.rbdalgos, len(facts.tree_joints)
    x = cs.SX.sym("x", 10 * n)
    for node, joint in enumerate(algorithms._joints_per_node):
        if joint is not None and joint.idx is not None:
            k = int(joint.idx)
            algorithms._spatial_inertias[node] = CasadiLike(
                spatial_inertia(x[10 * k : 10 * k + 10])
            )
    q, qd, qdd = (cs.SX.sym(name, n) for name in ("q", "qd", "qdd"))
    base, still = np.eye(4), np.zeros(6)
    M, _ = algorithms.crba(base, q)
    h = algorithms.rnea(base, q, still, qd, gravity)
    tau = M.array[6:, 6:] @ qdd + h.array[6:]
    one = cs.Function("Y", [q, qd, qdd], [cs.jacobian(tau, x)], {"cse": True})

    def regressor(q: Any, qd: Any, qdd: Any) -> Any:
        found = one.map(len(q))(q.T, qd.T, qdd.T).full()
        return found.reshape(n, len(q), 10 * n).transpose(1, 0, 2)

    return regressor


def spatial_inertia(link: Any) -> Any:
    """Return the inertia (6, 6), linear first, of `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m`."""
    Ixx, Ixy, Ixz, Iyy, Iyz, Izz, mx, my, mz, m = cs.vertsplit(link)
    S = cs.skew(cs.vertcat(mx, my, mz))
    I = cs.vertcat(cs.horzcat(Ixx, Ixy, Ixz), cs.horzcat(Ixy, Iyy, Iyz), cs.horzcat(Ixz, Iyz, Izz))
    return cs.vertcat(cs.horzcat(m * cs.SX.eye(3), S.T), cs.horzcat(S, I))
