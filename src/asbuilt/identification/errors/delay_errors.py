"""Delay of the torque as a column of a fit: estimate, standard error, and what it adds to others.

A torque that is logged late by d is `tau(t) = Y(t - d) beta`, to first order `W beta + c d` with
`c = -d(W beta)/dt`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.identification.errors.block_scatter import widening
from asbuilt.identification.errors.leverage import TINY, block_variances
from asbuilt.identification.errors.uncertainty import FEWEST_BLOCKS
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import sample_blocks
from asbuilt.identification.result.torque_prediction import model_torque

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


@dataclass(frozen=True, slots=True, eq=False)
class DelaySolution:
    """Hold increments (m,) [s] of delays and their covariance (m, m), infinite if undetermined.

    `follows` (p, m) is the change of the base parameters per delay, `swell` (m,) the standard error
    from time blocks in those for independent residuals.
    """

    increments: Array
    covariance: Array
    follows: Array
    swell: Array
    n_blocks: int

    @property
    def std_errors(self) -> Array:
        """Standard errors [s], (m,); infinite where a delay is undetermined."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class DelayColumns:
    """Hold the normal equations of an estimate with a delay of each recording and joint, by block.

    Joint k has two columns: k for the rate of its torque, n + k for that of its friction alone. In
    coordinates `beta = S x` with S (p, r) the inverse root of the estimate: `grams` (B, r, r),
    `across` (B, r, 2 n) with these columns, `own` (B, 2 n, 2 n) among them, and the scores
    `beta_scores` (B, r) and `delay_scores` (B, 2 n) of the residual, joints weighted. `place` (B,)
    is that of each block's recording among R.
    """

    grams: Array
    across: Array
    own: Array
    beta_scores: Array
    delay_scores: Array
    place: Array
    root: Array

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.own.shape[1] // 2)

    @cached_property
    def _known(self) -> Array:
        return np.asarray(np.linalg.pinv(self.grams.sum(axis=0), hermitian=True))

    def solve(self, shares: Array, *, textbook: bool = False) -> DelaySolution:
        """Return the delays that lower the residual most, and what they add to other errors.

        `shares` (R, 2 n, m) are the delays of each recording and column per free delay. With `C'`
        the columns projected off all others, the covariance is `(C'^T C')^-1`, or that from time
        blocks if it is larger (CR2 with Student's quantile, as in `block_uncertainty`). The base
        parameters follow by `-(W^T W)^-1 W^T C` (Frisch and Waugh, Econometrica 1, 1933).
        """
        spread = shares[self.place]
        A = np.einsum("brk,bkm->brm", self.across, spread)
        D = np.einsum("bkl,bkj,bjm->blm", spread, self.own, spread, optimize=True)
        moved = self._known @ A.sum(axis=0)
        own = np.einsum("bkm,bk->bm", spread, self.delay_scores)
        scores = own - self.beta_scores @ moved
        mixed = np.einsum("brm,rl->bml", A, moved)
        grams = (
            D
            - mixed
            - mixed.transpose(0, 2, 1)
            + np.einsum("rm,brs,sl->bml", moved, self.grams, moved)
        )
        left, whole = grams.sum(axis=0), D.sum(axis=0)
        m = shares.shape[-1]
        # Squared part of a delay's column outside all others below which it is undetermined.
        found = np.flatnonzero(np.diag(left) > 1e-9 * np.maximum(np.diag(whole), TINY))
        increments, swell = np.zeros(m), np.ones(m)
        covariance = np.diag(np.full(m, np.inf))
        if found.size:
            inverse = np.linalg.inv(left[np.ix_(found, found)])
            increments[found] = inverse @ scores.sum(axis=0)[found]
            if not textbook and len(scores) >= FEWEST_BLOCKS:
                scatter, freedom = block_variances(
                    inverse, grams[:, found][:, :, found], scores[:, found]
                )
                swell[found] = np.sqrt(np.maximum(scatter * widening(freedom) ** 2, 1.0))
            covariance[np.ix_(found, found)] = inverse * np.outer(swell[found], swell[found])
        return DelaySolution(increments, covariance, -self.root @ moved, swell, len(scores))


@dataclass(frozen=True, slots=True, eq=False)
class DelayErrors:
    """Hold what estimated delays add to the covariance (p, p) of base parameters.

    `shift` (p,) is what the parameters would move by if no delay were applied.
    """

    covariance: Array
    shift: Array


def delay_errors(
    model: RobotModel,
    base: BaseParameters,
    estimate: Estimate,
    samples: Sequence[Samples],
    *,
    textbook: bool = False,
    block_seconds: float | None = None,
) -> DelayErrors | None:
    """Return what the estimated delays of samples add to errors; None if none was estimated.

    An error is at least that with which the delay was estimated.
    """
    n = model.n_joints
    free = [(r, k) for r, batch in enumerate(samples) for k in range(len(batch.delay_errors))]
    if not free:
        return None
    shares = np.zeros((len(samples), 2 * n, len(free)))
    for place, (r, k) in enumerate(free):
        joints = slice(n) if len(samples[r].delay_errors) == 1 else slice(k, k + 1)
        shares[r, joints, place] = 1.0
    columns = delay_columns(model, base, estimate, samples, block_seconds=block_seconds)
    solved = columns.solve(shares, textbook=textbook)
    known = np.array([samples[r].delay_errors[k] for r, k in free])
    found = np.isfinite(np.diag(solved.covariance))
    size = np.sqrt(np.diag(solved.covariance)[found])
    swell = np.maximum(known[found] / size, 1.0)
    V = solved.covariance[np.ix_(found, found)] * np.outer(swell, swell)
    follows = solved.follows[:, found]
    delays = np.array([samples[r].delay[k] for r, k in free])[found]
    return DelayErrors(np.asarray(follows @ V @ follows.T), np.asarray(-follows @ delays))


def delay_columns(
    model: RobotModel,
    base: BaseParameters,
    estimate: Estimate,
    samples: Sequence[Samples],
    *,
    block_seconds: float | None = None,
) -> DelayColumns:
    """Return the normal equations of an estimate with a delay of each recording and joint."""
    plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=3)
    root, weights, n = estimate.solution.inverse_root, estimate.weights, model.n_joints
    r = root.shape[1]
    parts: list[tuple[Array, Array, Array, Array, Array, int]] = []
    with one_blas_thread():
        for place, batch in enumerate(samples):
            beside = _torque_rates(model, base, estimate.beta, batch)
            for part in sample_blocks(model, [batch], block_seconds):
                gram, across = np.zeros((r, r)), np.zeros((r, 2 * n))
                own, by_delay, by_beta = np.zeros((2 * n, 2 * n)), np.zeros(2 * n), np.zeros(r)
                for chunk in part.chunks(plan, beside):
                    for k, rows in enumerate(chunk):
                        columns, c, tau = rows[:-3], -weights[k] * rows[-3:-1], rows[-1]
                        x = root[plan.support[k]].T @ columns * weights[k]
                        e = weights[k] * (tau - estimate.beta[plan.support[k]] @ columns)
                        both = [k, n + k]
                        gram += x @ x.T
                        across[:, both] += x @ c.T
                        own[np.ix_(both, both)] += c @ c.T
                        by_delay[both] += c @ e
                        by_beta += x @ e
                parts.append((gram, across, own, by_beta, by_delay, place))
    grams, across, own, by_beta, by_delay, places = map(np.array, zip(*parts, strict=True))
    return DelayColumns(grams, across, own, by_beta, by_delay, places, root)


def _torque_rates(
    model: RobotModel, base: BaseParameters, beta: Array, samples: Samples
) -> Callable[[slice], list[Array]]:
    """Return what gives the rates of torque and friction [N m/s], each (L, n), on a span."""
    rigid, torque = model_torque(model, base, beta, samples)
    rates = np.zeros((2, *torque.shape))
    for a, b in samples.segments:
        if b - a > 1:
            for rate, part in zip(rates, (torque, torque - rigid), strict=True):
                rate[a:b] = np.gradient(part[a:b], 1.0 / samples.rate, axis=0)
    return lambda span: [rate[span] for rate in rates]
