"""Scores of a tool on a task: the same lines for every tool."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from plain import EDGE, Motion, low_pass
from task import Norm

Array = Any
SURE = 1.96
"""Standard errors of a 95 % interval."""
TOUCHING = -1e-6
"""Eigenvalue of a pseudo-inertia, relative to its trace, down to which it counts as consistent:
what solvers of cones leave."""


def torque_errors(
    states: Motion, hidden: Array, answer: Array, rate: float, cutoff: float, edge: float = EDGE
) -> tuple[Array, Array]:
    """Return root mean squares (n,) of the error and of the torque, both low-passed, edges off."""
    rows = states.inner(edge)
    error, torque = (low_pass(x, rate, cutoff)[rows] for x in (hidden - answer, hidden))
    return np.sqrt(np.mean(error**2, axis=0)), np.sqrt(np.mean(torque**2, axis=0))


def weight_ratio(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> tuple[float, float]:
    """Return the ratio of two weights and its standard error, from their first moments.

    The ratio is that of least squares from the moments of the first weight to those of the second.
    """
    a, b = (np.array([each["value"] for each in moments]) for moments in (first, second))
    of_a, of_b = (np.array([each["error"] ** 2 for each in x]) for x in (first, second))
    ratio = float(a @ b / (a @ a))
    return ratio, float(np.sqrt(np.sum(a**2 * (of_b + ratio**2 * of_a))) / (a @ a))


def relative_error(
    pairs: list[tuple[Array, Array]], norm: Norm, limits: Array | None = None
) -> tuple[float, list[float]]:
    """Return the error of several tests in a norm, and that of each joint.

    `torque`: `|tau - tau_hat| / |tau|` over all joints and tests. `joints`: the mean over joints
    of that of one joint, for robots whose joints have different units. `limits`: the mean over
    joints of the error over the range of the torque, twice its limit (n,), as FloBaRoID's NRMS.
    """
    error, torque = (np.sum([pair[i] ** 2 for pair in pairs], axis=0) for i in (0, 1))
    if norm == "limits":
        torque = len(pairs) * (2.0 * np.asarray(limits)) ** 2
    each = np.sqrt(error / torque)
    whole = np.sqrt(error.sum() / torque.sum()) if norm == "torque" else each.mean()
    return float(whole), [float(x) for x in each]


def consistent(links: Array) -> bool:
    """Whether all pseudo-inertias of links (n, 10) are positive semidefinite."""
    for Ixx, Ixy, Ixz, Iyy, Iyz, Izz, mx, my, mz, m in np.asarray(links):
        half = 0.5 * (Ixx + Iyy + Izz)
        P = np.array(
            [
                [half - Ixx, -Ixy, -Ixz, mx],
                [-Ixy, half - Iyy, -Iyz, my],
                [-Ixz, -Iyz, half - Izz, mz],
                [mx, my, mz, m],
            ]
        )
        if np.linalg.eigvalsh(P)[0] < TOUCHING * max(np.trace(P), 1e-12):
            return False
    return True


def agreement(one: list[dict[str, Any]], other: list[dict[str, Any]]) -> Array:
    """Return `z = (a - b) / sqrt(s_a^2 + s_b^2)` of the parameters that both halves have."""
    second = {each["name"]: each for each in other}
    return np.array(
        [
            (a["value"] - b["value"]) / math.hypot(a["error"], b["error"])
            for a in one
            if (b := second.get(a["name"])) and math.hypot(a["error"], b["error"]) > 0.0
        ]
    )


def against_truth(parameters: list[dict[str, Any]], truth: dict[str, float]) -> Array:
    """Return `z = (estimate - truth) / error` of the parameters whose truth is known."""
    return np.array(
        [
            (each["value"] - sum(f * truth[name] for name, f in each["of"].items())) / each["error"]
            for each in parameters
            if each["error"] > 0.0 and each["of"] and all(name in truth for name in each["of"])
        ]
    )


def coverage(z: Array) -> dict[str, float]:
    """Return the share of 95 % intervals that hold, and the root mean square of z (1 is right)."""
    if not len(z):
        return {}
    return {
        "coverage": float(np.mean(np.abs(z) < SURE)),
        "z_rms": float(np.sqrt(np.mean(z**2))),
        "parameters": len(z),
    }
