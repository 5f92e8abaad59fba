"""Stiffness of position servos from the only scale that a command has: the masses of CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.terms.friction import Offset
from asbuilt.identification.servo.block_fits import block_weights, sum_clusters
from asbuilt.identification.servo.servo_rows import ServoRows

Scale = Literal["gravity", "inertia"]


@dataclass(frozen=True, slots=True)
class ScaleRules:
    """Say when a stiffness is determined, and how well CAD masses are trusted.

    Parameters
    ----------
    cad
        Standard deviation of the scale of CAD torques, as a fraction: own choice for parts of known
        material and weighed motors.
    determined
        Relative standard error of a stiffness beyond which a recording does not determine it.
    passes
        Passes of the robust weights of time blocks.
    """

    cad: float = 0.1
    determined: float = 0.3
    passes: int = 20


RULES = ScaleRules()


@dataclass(frozen=True, slots=True, eq=False)
class ServoScale:
    """Hold the stiffness of each joint's servo with its errors.

    Parameters
    ----------
    kp, std_errors
        Stiffness [N m/rad or N/m] and its standard error with that of CAD, (n,).
    determined
        Whether the joint's own rows determine it, (n,).
    shared
        Whether one stiffness was fitted to all joints.
    source
        What gives the scale of each joint: gravity or inertia of CAD.
    """

    kp: Array
    std_errors: Array
    determined: Mask
    shared: bool
    source: tuple[Scale, ...]


def find_scale(
    rows: ServoRows,
    base: BaseParameters,
    design: Array,
    kd: Sequence[float],
    unknown: Mask,
    *,
    shared: bool,
) -> ServoScale:
    """Fit `u - q = c tau_cad + drive terms + c kd qd`, c = 1 / kp, joint by joint.

    `tau_cad` is the rigid-body torque of the links by design (`design`, standard parameters with
    drives zero); armature and friction of the joint are free and have no scale. There is no
    constant torque: a servo has none, and over a small range of motion gravity is almost constant,
    so that a constant would take its place. Blocks of time weigh `1 / (1 + r / median(r))` with
    their residual variance r, so that contact does not count. The stiffness is shared by all
    unknown joints if asked, or if some joint's rows do not determine its own.

    Raises nothing: a stiffness that nothing determines has an infinite standard error.
    """
    n = unknown.size
    c, V, source = np.full(n, np.nan), np.full(n, np.inf), ["gravity"] * n
    for k in np.flatnonzero(unknown).tolist():
        c[k], V[k], source[k] = _estimate_own_scale(rows, base, design, kd[k], k)
    good = unknown & (c > 0) & np.isfinite(V)
    determined = good & (np.sqrt(V) < RULES.determined * np.where(good, c, 1.0))
    pooled = shared or not np.all(determined[unknown])
    if pooled and np.any(good):
        weight = np.where(good, 1.0 / V, 0.0)
        mean = float(np.sum(weight[good] * c[good]) / np.sum(weight))
        spread = np.sum(weight[good] * (c[good] - mean) ** 2) / max(np.count_nonzero(good) - 1, 1)
        c[unknown], V[unknown] = mean, max(spread, 1.0) / np.sum(weight)
    with np.errstate(divide="ignore", invalid="ignore"):
        kp = np.where(c > 0, 1.0 / c, np.nan)
        relative = np.where(c > 0, np.sqrt(V) / c, np.inf)
    errors = kp * np.sqrt(relative**2 + RULES.cad**2)
    return ServoScale(kp, errors, determined, pooled, tuple(source))  # type: ignore[arg-type]


def _estimate_own_scale(
    rows: ServoRows, base: BaseParameters, design: Array, kd: float, k: int
) -> tuple[float, float, Scale]:
    """Return c of a joint, its variance from time blocks, and what gives it."""
    own = rows.support[k]
    K = base.regrouping[own]
    drives = K[:, 10 * base.n_links :][:, _find_varying_columns(base)]
    parts = {
        "gravity": np.where(np.arange(base.n_standard) % 10 >= 6, design, 0.0),
        "inertia": np.where(np.arange(base.n_standard) % 10 < 6, design, 0.0),
    }
    T = np.zeros((own.size + 3, 1 + drives.shape[1]))
    T[: own.size, 0], T[: own.size, 1:] = K @ design, drives
    T[own.size, 0] = np.nan_to_num(kd)
    T = T[:, [0, *(1 + np.flatnonzero(np.any(drives != 0.0, axis=0)))]]
    weight = np.ones(len(rows.times))
    for _ in range(RULES.passes):
        gram = rows.total(k, weight)
        normal = T.T @ gram @ T
        x = np.linalg.lstsq(normal, T.T @ gram[:, -1], rcond=1e-12)[0]
        a = -T @ x
        a[-1] += 1.0
        weight = block_weights(rows, k, a)
    inverse = np.linalg.pinv(normal, hermitian=True)
    scores = sum_clusters(weight * (rows.grams[k] @ a @ (T @ inverse[0])), rows)
    rest, size = np.linalg.pinv(normal[1:, 1:], hermitian=True), {}
    for name, part in parts.items():
        t = np.zeros(own.size + 3)
        t[: own.size] = K @ part
        across = T[:, 1:].T @ gram @ t
        size[name] = float(t @ gram @ t - across @ rest @ across)
    source: Scale = "gravity" if size["gravity"] >= size["inertia"] else "inertia"
    alone = normal[0, 0] - normal[0, 1:] @ rest @ normal[1:, 0]
    if alone <= 1e-9 * normal[0, 0]:
        return float("nan"), float("inf"), source
    return float(x[0]), float(np.sum(scores**2)), source


def _find_varying_columns(base: BaseParameters) -> Indices:
    """Return the drive columns that are no constant torque.

    Rows have columns of other joints only where forces at contacts are projected away.
    """
    varies = [s not in Offset.symbols for term in base.drive.terms for s in term.symbols]
    return np.flatnonzero(np.resize(varies, base.n_standard - 10 * base.n_links))
