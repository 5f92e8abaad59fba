"""Doubt of friction that takes another share of the load where the load drives the motor."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.findings import join_names
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.uncertainty.bias import OmittedBias, derive_estimate_moves
from asbuilt.scaled import Scaled


def doubt_driving_friction(
    information: SquareRootInformation, estimate: Estimate
) -> OmittedBias | None:
    """Return what one share of the load for both ways of driving lends the parameters, if any.

    Friction `a |load| sign(qd)` where the motor drives and `b |load| sign(qd)` where the load does
    is `(a + b)/2 |load| sign(qd) + (a - b)/2 load`: load friction, and a factor on the load, which
    bodies and a torque gain have as well. No log has more of a - b. As neither way friction drives,
    `|a - b| <= a + b = 2 Fl`: uniform within, with the standard deviation `Fl / sqrt(3)` of the
    factor at each joint. The rows of joint k then lack `W_k beta`, W of the bodies alone.
    """
    base = information.base
    links = base.columns < 10 * base.n_links
    shares, columns = [], []
    for k, (support, factor) in enumerate(
        zip(information.support, information.joint_factors, strict=True)
    ):
        place = [j for j in support.tolist() if base.names[j] == f"Fl{k + 1}"]
        if place and estimate.beta[place[0]] > 0.0:
            load = np.where(links[support], estimate.beta[support], 0.0)
            shares.append((k, float(estimate.beta[place[0]])))
            columns.append((k, support, factor[:, :-1].T @ (factor[:, :-1] @ load)))
    if not shares:
        return None
    spread = np.array([share for _, share in shares]) / np.sqrt(3.0)

    def follow(weights: Array) -> Array:
        """Return how weighted least squares moves (p, joints) per factor on the load."""
        root = information.stacked(weights)[:, :-1]
        sides = np.zeros((base.n_base, len(columns)))
        for side, (k, support, score) in zip(sides.T, columns, strict=True):
            side[support] = weights[k] ** 2 * score
        return Scaled(root.T @ root).solve(sides)

    moves = derive_estimate_moves(information, estimate) @ follow(estimate.weights)
    plain = fit_least_squares(information, weights="joint", prior=estimate.beta)
    free = follow(plain.weights)
    names = [f"{information.joint_names[k]} ({100.0 * share:.1f} %)" for k, share in shares]
    none = np.zeros(base.n_base)
    return OmittedBias(
        bias=none,
        covariance=(moves * spread**2) @ moves.T,
        free_bias=none,
        free_covariance=(free * spread**2) @ free.T,
        effects="another friction where the load drives the motor, which is confounded with a"
        f" torque gain: at most the load friction, of {join_names(names, 4)}",
    )
