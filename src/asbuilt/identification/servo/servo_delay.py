"""Delay of a position servo: a fit with the robot's parameters, regularised toward CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, solve_triangular
from scipy.optimize import lsq_linear

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.identification.errors.delay_errors import DelayErrors
from asbuilt.identification.errors.expected_scores import DOUBT
from asbuilt.identification.errors.uncertainty import FEWEST_BLOCKS
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.servo.block_fits import block_weights, sum_clusters
from asbuilt.identification.servo.servo_replay import Replay
from asbuilt.identification.servo.servo_rows import ServoRows


@dataclass(frozen=True, slots=True, eq=False)
class DelaySlopes:
    """Hold `sum of W_k kp du/dt` of each joint's rows by parameter name, per sample.

    The torque `kp (u(t - d) - q)` falls by `kp du/dt` per delay.
    """

    names: tuple[tuple[str, ...], ...]
    means: tuple[Array, ...]

    @classmethod
    def of(
        cls, rows: ServoRows, base: BaseParameters, counted: Sequence[bool], kp: Sequence[float]
    ) -> DelaySlopes:
        """Return the slopes of rows whose time blocks count."""
        weight, names, means = np.array(counted, dtype=np.float64), [], []
        count = float(weight @ rows.lengths)
        for k, support in enumerate(rows.support):
            gram = rows.total(k, weight)
            names.append(tuple(base.names[j] for j in support))
            means.append(kp[k] * gram[: support.size, support.size + 1] / max(count, 1.0))
        return cls(tuple(names), tuple(means))


def estimate_servo_delay_errors(
    information: SquareRootInformation,
    estimate: Estimate,
    slopes: DelaySlopes,
    delay: float,
    std_error: float,
) -> DelayErrors | None:
    """Return what a delay with this standard error [s] adds; None if it is known.

    Parameters follow the delay by `-(W^T W)^-1 sum_k w_k^2 kp_k W_k^T du/dt`, with the information
    of the estimate, CAD's included.
    """
    if not 0.0 < std_error < np.inf:
        return None
    base = information.base
    place = {name: j for j, name in enumerate(base.names)}
    side = np.zeros(base.n_base)
    for names, mean, weight in zip(slopes.names, slopes.means, estimate.weights, strict=True):
        for name, value in zip(names, mean, strict=True):
            if name in place:
                side[place[name]] += weight**2 * value * information.n_samples
    root = estimate.solution.inverse_root
    follows = -root @ (root.T @ side)
    return DelayErrors(np.outer(follows, follows) * std_error**2, -follows * delay)


@dataclass(frozen=True, slots=True)
class DelayRules:
    """Settings of the fit.

    Parameters
    ----------
    links
        Weight of CAD per link, in samples: the strongest of the automatic choice.
    drives
        Standard deviation of drive parameters before the data [SI units], practically free.
    passes
        Passes of the weights of joints and blocks.
    """

    links: float = 25.0
    drives: float = 1e3
    passes: int = 8


RULES = DelayRules()


@dataclass(frozen=True, slots=True, eq=False)
class DelayFit:
    """Hold the change of the delay [s] from that of the rows, and its standard error.

    `excess` (B,) is the largest residual of a joint in each block, in those of its median block;
    `parameters` (n_standard,) are the standard parameters.
    """

    step: float
    std_error: float
    excess: Array
    parameters: Array


def fit_delay(
    rows: ServoRows,
    base: BaseParameters,
    design: CadPrior,
    kp: Sequence[float],
    kd: Sequence[float],
    replayed: Replay | None = None,
) -> DelayFit:
    """Fit `kp (u - q) - kd qd = W beta + step kp du/dt` with passive drives.

    Links have a prior from CAD. What does not average out (`replayed`) is taken off the scores.
    Blocks weigh as in `find_scale`. The standard error comes from the scores of time blocks, with
    everything that is not at its bound free (Frisch and Waugh, Econometrica 1, 1933). It is at
    least that of the noise that was replayed; without a replay, or with too few blocks, that of
    independent residuals. Without a replay it is also at least what joints disagree by, the only
    sign of what does not average out. What is taken off has an error too (`DOUBT`).
    """
    n, p = len(rows.support), base.n_standard
    prior, links = np.eye(p + 1) / RULES.drives**2, slice(10 * base.n_links)
    prior[links, links] = RULES.links * block_diag(*design.metric)
    prior[p, p] = 0.0
    start, lower = np.zeros(p + 1), np.full(p + 1, -np.inf)
    start[links], lower[design.non_negative] = design.parameters[links], 0.0
    maps = [_build_coefficients(rows, base, k, kp[k], kd[k]) for k in range(n)]
    reached = [np.flatnonzero(np.any(J != 0.0, axis=0)) for J, _ in maps]
    weight, lengths = np.ones((n, len(rows.times))), rows.lengths
    x, scale, free = start, np.ones(n), np.arange(p + 1)
    for _ in range(RULES.passes):
        normal, right = prior.copy(), prior @ start
        for k, (whole, torque) in enumerate(maps):
            J, at = whole[:, reached[k]], reached[k]
            weighted = J.T @ rows.total(k, weight[k])
            normal[np.ix_(at, at)] += weighted @ J
            right[at] += weighted @ torque
            if replayed is not None:
                right[at] -= float(weight[k] @ lengths) * (J[:-1].T @ replayed.weighted[k])
        x, free = _solve_bounded(normal, right, lower, free)
        residuals = [torque - J @ x for J, torque in maps]
        for k, residual in enumerate(residuals):
            own = block_weights(rows, k, residual)
            energy = float(residual @ rows.total(k, own) @ residual)
            scale[k] = float(own @ rows.counts[k]) / max(energy, 1e-300)
            weight[k] = own * scale[k]
    inverse = np.linalg.inv(normal[np.ix_(free, free)])[-1]
    scores, along, by_joint, taken = np.zeros(len(rows.times)), [], [], 0.0
    for k, ((J, _), residual) in enumerate(zip(maps, residuals, strict=True)):
        along.append(J[:-1, free] @ inverse)
        own = weight[k] * ((rows.grams[k] @ residual)[:, :-1] @ along[k])
        if replayed is not None:
            less = weight[k] * lengths * float(replayed.weighted[k] @ along[k])
            own, taken = own - less, taken + float(np.sum(less))
        scores += own
        by_joint.append(float(np.sum(own)))
    variance, together = float(inverse[-1]), sum_clusters(scores, rows)
    if together.size >= FEWEST_BLOCKS:
        least = variance
        if replayed is not None and replayed.sees_noise:
            least = replayed.variance([scale[k] * each for k, each in enumerate(along)])
        scatter = float(together @ together) * together.size / (together.size - 1)
        variance = max(least, scatter)
    if replayed is None:
        variance = max(variance, float(np.square(by_joint).sum()))
    variance += (DOUBT * taken) ** 2
    left = np.array([rows.variances(k, residual) for k, residual in enumerate(residuals)])
    usual = np.array([np.nanmedian(each) if np.isfinite(each).any() else np.inf for each in left])
    excess = np.sqrt(np.max(np.nan_to_num(left / usual[:, None]), axis=0))
    return DelayFit(float(x[-1]), float(np.sqrt(variance)), excess, x[:-1])


def _build_coefficients(
    rows: ServoRows, base: BaseParameters, k: int, kp: float, kd: float
) -> tuple[Array, Array]:
    """Return a joint's rows in terms of parameters and delay, and its torque, as coefficients."""
    own = rows.support[k]
    J = np.zeros((own.size + 3, base.n_standard + 1))
    J[: own.size, :-1] = base.regrouping[own]
    J[own.size + 1, -1] = kp
    torque = np.zeros(own.size + 3)
    torque[own.size], torque[own.size + 2] = -kd, kp
    return J, torque


def _solve_bounded(
    normal: Array, right: Array, lower: Array, near: Indices
) -> tuple[Array, Indices]:
    """Return the solution of normal equations above its bounds, and what is not at a bound.

    `near` is what was not at a bound for similar equations: if it still is not, and all else has
    the gradient that holds it there, that is the solution. Bounds are zero.
    """
    scale = 1.0 / np.sqrt(np.diag(normal))
    scaled, aim = normal * np.outer(scale, scale), right * scale
    x, held = np.zeros(len(aim)), np.ones(len(aim), dtype=np.bool_)
    x[near], held[near] = cho_solve(cho_factor(scaled[np.ix_(near, near)]), aim[near]), False
    if np.all(x[near] > lower[near]) and np.all((scaled @ x - aim)[held] >= 0.0):
        return x * scale, near
    root = np.linalg.cholesky(scaled).T
    target = solve_triangular(root, aim, trans="T")
    found = lsq_linear(root, target, bounds=(lower, np.inf), method="bvls")
    return found.x * scale, np.flatnonzero(found.active_mask == 0)
