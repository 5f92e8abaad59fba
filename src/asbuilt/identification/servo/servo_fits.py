"""Fits of a position servo: its stiffness by the masses of CAD, and its delay.

Masses are the only scale that a command has. The delay is fitted with the robot's parameters,
regularised toward CAD.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, solve_triangular

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.drives.terms.friction import Offset
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.information.equations import Equations
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.servo.servo_replay import Replay
from asbuilt.identification.servo.servo_rows import (
    block_energies,
    block_variances,
    block_weights,
    sum_clusters,
)
from asbuilt.identification.uncertainty.delay_errors import DelayErrors
from asbuilt.identification.uncertainty.pose_noise import DOUBT, MeanScores
from asbuilt.identification.uncertainty.uncertainty import FEWEST_BLOCKS
from asbuilt.scaled import Scaled

Scale = Literal["gravity", "inertia"]


# Say when a stiffness is determined, and how well CAD masses are trusted.

# Standard deviation of the scale of CAD torques, as a fraction: own choice for parts of known
# material and weighed motors
SCALE_CAD = 0.1
# Relative standard error of a stiffness beyond which a recording does not determine it
SCALE_DETERMINED = 0.3
SCALE_PASSES = 20  # Passes of the robust weights of time blocks


@dataclass(frozen=True, slots=True, eq=False)
class ServoScale:
    """Hold the stiffness of each joint's servo with its errors.

    Parameters
    ----------
    kp, std_errors
        Stiffness [N m/rad or N/m] and its standard error, CAD's included, (n,).
    shared
        Whether one stiffness was fitted to all joints.
    source
        What gives the scale of each joint: gravity or inertia of CAD.
    """

    kp: Array
    std_errors: Array
    shared: bool
    source: tuple[Scale, ...]


def find_scale(
    rows: Equations,
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
    their residual variance r, so that collisions do not count. The stiffness is shared by all
    unknown joints if asked, or if some joint's rows do not determine its own.

    Raises nothing: a stiffness that nothing determines has an infinite standard error.
    """
    n = unknown.size
    c = np.full(n, np.nan)
    V = np.full(n, np.inf)
    source = ["gravity"] * n
    for k in np.flatnonzero(unknown).tolist():
        c[k], V[k], source[k] = _estimate_own_scale(rows, base, design, kd[k], k)
    good = unknown & (c > 0) & np.isfinite(V)
    determined = good & (np.sqrt(V) < SCALE_DETERMINED * np.where(good, c, 1.0))
    pooled = shared or not np.all(determined[unknown])
    if pooled and np.any(good):
        weight = np.where(good, 1.0 / V, 0.0)
        mean = float(np.sum(weight[good] * c[good]) / np.sum(weight))
        # Joints that scatter beyond their errors raise the error of their mean (ratio of Birge).
        spread = np.sum(weight[good] * (c[good] - mean) ** 2) / max(np.count_nonzero(good) - 1, 1)
        c[unknown] = mean
        V[unknown] = max(spread, 1.0) / np.sum(weight)
    with np.errstate(divide="ignore", invalid="ignore"):
        kp = np.where(c > 0, 1.0 / c, np.nan)
        relative = np.where(c > 0, np.sqrt(V) / c, np.inf)
    # The scale of CAD is an error that all joints share, whatever the recording says.
    errors = kp * np.sqrt(relative**2 + SCALE_CAD**2)
    return ServoScale(kp, errors, pooled, tuple(source))  # type: ignore[arg-type]


def _estimate_own_scale(
    rows: Equations, base: BaseParameters, design: Array, kd: float, k: int
) -> tuple[float, float, Scale]:
    """Return c of a joint, its variance from time blocks, and what gives it."""
    support = rows.in_model(k)
    K = base.regrouping[support]
    drives = K[:, 10 * base.n_links :][:, _find_varying_columns(base)]
    # Of the ten of a link gravity acts by first moments and mass; the six inertias do the rest.
    parts = {
        "gravity": np.where(np.arange(base.n_standard) % 10 >= 6, design, 0.0),
        "inertia": np.where(np.arange(base.n_standard) % 10 < 6, design, 0.0),
    }
    T = np.zeros((support.size + 3, 1 + drives.shape[1]))
    T[: support.size, 0] = K @ design
    T[: support.size, 1:] = drives
    # Unknown damping stays in the viscous friction.
    T[support.size, 0] = np.nan_to_num(kd)
    # A joint has no columns of the drives of others.
    T = T[:, [0, *(1 + np.flatnonzero(np.any(drives != 0.0, axis=0)))]]
    weight = np.ones(rows.n_blocks)
    for _ in range(SCALE_PASSES):
        gram = rows.of_joint(k, weight)
        normal = T.T @ gram @ T
        x = Scaled(normal).solve(T.T @ gram[:, -1])
        # The residual (u - q) - T x as a combination of the joint's rows.
        a = -T @ x
        a[-1] += 1.0
        weight = block_weights(rows, k, a)
    inverse = Scaled(normal).pseudo_inverse
    # Scores of the blocks along the row of the inverse that belongs to c.
    scores = sum_clusters(weight * (rows.grams[k] @ a @ (T @ inverse[0])), rows)
    rest = Scaled(normal[1:, 1:]).pseudo_inverse
    size = {}
    for name, part in parts.items():
        t = np.zeros(support.size + 3)
        t[: support.size] = K @ part
        # What of gravity or inertia the free drive terms cannot imitate.
        across = T[:, 1:].T @ gram @ t
        size[name] = float(t @ gram @ t - across @ rest @ across)
    source: Scale = "gravity" if size["gravity"] >= size["inertia"] else "inertia"
    # Schur complement of c: without a part of its own the rows show no stiffness.
    alone = normal[0, 0] - normal[0, 1:] @ rest @ normal[1:, 0]
    if alone <= 1e-9 * normal[0, 0]:
        return float("nan"), float("inf"), source
    return float(x[0]), float(np.sum(scores**2)), source


def _find_varying_columns(base: BaseParameters) -> Indices:
    """Return the drive columns that are no constant torque.

    Rows have columns of other joints only where reactions are projected away.
    """
    varies = [s not in Offset.symbols for term in base.drive.terms for s in term.symbols]
    return np.flatnonzero(np.resize(varies, base.n_standard - 10 * base.n_links))


def average_slopes(
    rows: Equations, base: BaseParameters, counted: Sequence[bool], kp: Sequence[float]
) -> MeanScores:
    """Return the scores of `kp du/dt` of rows whose time blocks count.

    The torque `kp (u(t - d) - q)` falls by `kp du/dt` per delay.
    """
    supports = [rows.in_model(k) for k in range(rows.n_joints)]
    weight = np.array(counted, dtype=np.float64)
    count = max(float(weight @ rows.lengths), 1.0)
    means = (
        kp[k] * rows.of_joint(k, weight)[: support.size, support.size + 1] / count
        for k, support in enumerate(supports)
    )
    names = (tuple(base.names[j] for j in support) for support in supports)
    return MeanScores(tuple(names), tuple(means))


def estimate_servo_delay_errors(
    information: SquareRootInformation,
    estimate: Estimate,
    slopes: MeanScores,
    delay: float,
    std_error: float,
) -> DelayErrors | None:
    """Return what a delay with this standard error [s] adds; None if it is known.

    Parameters follow the delay by `-(W^T W)^-1 sum_k w_k^2 kp_k W_k^T du/dt`, with the information
    of the estimate, CAD's included.
    """
    if not 0.0 < std_error < np.inf:
        return None
    follows = -slopes.follow(information, estimate)
    return DelayErrors(np.outer(follows, follows) * std_error**2, -follows * delay)


# Settings of the fit.

DELAY_LINKS = 25.0  # Weight of CAD per link, in samples: the strongest of the automatic choice
# Standard deviation of drive parameters before the data [SI units], practically free
DELAY_DRIVES = 1e3
DELAY_PASSES = 8  # Passes of the weights of joints and blocks


@dataclass(frozen=True, slots=True, eq=False)
class DelayFit:
    """Hold the change of the delay [s] that the rows have, and its standard error.

    `excess` (B,) is the largest residual of a joint in each block, in units of its median block;
    `parameters` (n_standard,) are the standard parameters. The torques are `ratios` (n,) times
    those of the gains.
    """

    step: float
    std_error: float
    excess: Array
    parameters: Array
    ratios: Array


def fit_delay(
    rows: Equations,
    base: BaseParameters,
    design: CadPrior,
    kp: Sequence[float],
    kd: Sequence[float],
    doubt: Array,
    replayed: Replay | None = None,
) -> DelayFit:
    """Fit `kp (u - q) - kd qd = (1 - r_k) W beta + step kp du/dt` with passive drives.

    Links have a prior from CAD. Links turn each other, so that the ratio of two stiffnesses that
    CAD gave is known from the motion far better than each, and a wrong one looks like a delay:
    r_k are fitted, with a standard deviation of `doubt` (n,) before the data. Their column is the
    torque that the model predicts, `-r_k W_k beta`: the measured one has the noise of the residual.
    What does not average out (`replayed`) is taken off the scores.
    Blocks weigh as in `find_scale`. The standard error comes from the scores of time blocks, with
    everything that is not at its bound free (Frisch and Waugh, Econometrica 1, 1933). It is at
    least the error by the noise that was replayed; without a replay, or with too few blocks, by
    independent residuals. Without a replay it is also at least what joints disagree by, the only
    sign of what does not average out. What is taken off has an error too (`DOUBT`).
    """
    n = rows.n_joints
    p = base.n_standard
    unsure = doubt > 0.0
    # Unknowns are standard parameters, ratios and the step of the delay.
    prior = np.eye(p + n + 1) / DELAY_DRIVES**2
    links = slice(10 * base.n_links)
    ratios = slice(p, p + n)
    prior[links, links] = DELAY_LINKS * block_diag(*design.metric)
    prior[ratios, ratios] = np.diag(1.0 / np.where(unsure, doubt, 1.0) ** 2)
    # Nothing is known of the delay beforehand.
    prior[-1, -1] = 0.0
    start = np.zeros(len(prior))
    lower = np.full(len(prior), -np.inf)
    start[links] = design.parameters[links]
    lower[design.non_negative] = 0.0
    maps = [_build_coefficients(rows, base, k, kp[k], kd[k]) for k in range(n)]
    reached = [
        np.flatnonzero(np.any(J != 0.0, axis=0) | (unsure[k] & (np.arange(p + n + 1) == p + k)))
        for k, (J, _) in enumerate(maps)
    ]
    weight = np.ones((n, rows.n_blocks))
    lengths = rows.lengths
    x = start
    scale = np.ones(n)
    free = np.arange(len(x))
    for _ in range(DELAY_PASSES):
        normal = prior.copy()
        right = prior @ start
        for k in np.flatnonzero(unsure).tolist():
            # What the last pass predicts, which is linear in the ratio.
            whole, _ = maps[k]
            whole[:, p + k] = -whole[:, :p] @ x[:p]
        for k, (whole, torque) in enumerate(maps):
            J = whole[:, reached[k]]
            at = reached[k]
            weighted = J.T @ rows.of_joint(k, weight[k])
            normal[np.ix_(at, at)] += weighted @ J
            right[at] += weighted @ torque
            if replayed is not None:
                # What the replay leaves in the scores of an exact model is no sign of the robot.
                right[at] -= float(weight[k] @ lengths) * (J[:-1].T @ replayed.weighted[k])
        x, free = _solve_bounded(normal, right, lower, free)
        residuals = [torque - J @ x for J, torque in maps]
        for k, residual in enumerate(residuals):
            # Noise variances of joints and weights of blocks follow from the residual in turn.
            own = block_weights(rows, k, residual)
            energy = float(own @ block_energies(rows, k, residual))
            scale[k] = float(own @ rows.counts[k]) / max(energy, 1e-300)
            weight[k] = own * scale[k]
    # The row of the delay, given everything that is not at a bound.
    inverse = np.linalg.inv(normal[np.ix_(free, free)])[-1]
    scores = np.zeros(rows.n_blocks)
    along = []
    by_joint = []
    taken = 0.0
    for k, ((J, _), residual) in enumerate(zip(maps, residuals, strict=True)):
        along.append(J[:-1, free] @ inverse)
        own = weight[k] * ((rows.grams[k] @ residual)[:, :-1] @ along[k])
        if replayed is not None:
            less = weight[k] * lengths * float(replayed.weighted[k] @ along[k])
            own = own - less
            taken = taken + float(np.sum(less))
        scores += own
        by_joint.append(float(np.sum(own)))
    variance = float(inverse[-1])
    together = sum_clusters(scores, rows)
    # With fewer blocks their scatter says nothing about its own size.
    if together.size >= FEWEST_BLOCKS:
        least = variance
        if replayed is not None and replayed.sees_noise:
            least = replayed.variance([scale[k] * follows for k, follows in enumerate(along)])
        variance = max(least, float(together @ together) * together.size / (together.size - 1))
    if replayed is None:
        # Without a replay the joints' disagreement is the one sign of what does not average out.
        variance = max(variance, float(np.square(by_joint).sum()))
    # What the motion leaves open of the ratios stays at CAD, with its error.
    of_ratios = (free >= p) & (free < p + n)
    open_ratios = inverse[of_ratios] / np.where(unsure, doubt, np.inf)[free[of_ratios] - p]
    variance += (DOUBT * taken) ** 2 + float(open_ratios @ open_ratios)
    left = np.array([block_variances(rows, k, residual) for k, residual in enumerate(residuals)])
    usual = np.array(
        [np.nanmedian(variances) if np.isfinite(variances).any() else np.inf for variances in left]
    )
    excess = np.sqrt(np.max(np.nan_to_num(left / usual[:, None]), axis=0))
    return DelayFit(float(x[-1]), float(np.sqrt(variance)), excess, x[:p], 1.0 / (1.0 - x[ratios]))


def _build_coefficients(
    rows: Equations, base: BaseParameters, k: int, kp: float, kd: float
) -> tuple[Array, Array]:
    """Return a joint's rows in terms of parameters and delay, and its torque, as coefficients."""
    support = rows.in_model(k)
    J = np.zeros((support.size + 3, base.n_standard + rows.n_joints + 1))
    J[: support.size, : base.n_standard] = base.regrouping[support]
    # Rows are [W_k, qd, du/dt, u - q]: of du/dt and u - q the gains are coefficients.
    J[support.size + 1, -1] = kp
    torque = np.zeros(support.size + 3)
    torque[support.size] = -kd
    torque[support.size + 2] = kp
    return J, torque


def _solve_bounded(
    normal: Array, right: Array, lower: Array, near: Indices
) -> tuple[Array, Indices]:
    """Return the solution of normal equations above its bounds, and what is not at a bound.

    `near` is what was not at a bound for similar equations: if it still is not, and all else has
    the gradient that holds it there, that is the solution. Bounds are zero.
    """
    # Unit diagonal: links and drives differ by many decades.
    scale = 1.0 / np.sqrt(np.diag(normal))
    scaled = normal * np.outer(scale, scale)
    aim = right * scale
    x = np.zeros(len(aim))
    held = np.ones(len(aim), dtype=np.bool_)
    # Most calls keep their active bounds: one Cholesky then verifies what bvls would search.
    x[near] = cho_solve(cho_factor(scaled[np.ix_(near, near)]), aim[near])
    held[near] = False
    if np.all(x[near] > lower[near]) and np.all((scaled @ x - aim)[held] >= 0.0):
        return x * scale, near
    from scipy.optimize import lsq_linear  # noqa: PLC0415 - light start

    # In the root the normal equations are a plain least-squares problem.
    root = np.linalg.cholesky(scaled).T
    target = solve_triangular(root, aim, trans="T")
    bounded = lsq_linear(root, target, bounds=(lower, np.inf), method="bvls")
    return bounded.x * scale, np.flatnonzero(bounded.active_mask == 0)
