"""Delay of the torque: a recording's, as a column of a fit, and what its error adds to others.

A torque that is logged late by d is `tau(t) = Y(t - d) beta`, to first order `W beta + c d` with
`c = -d(W beta)/dt`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.estimators.held_out_choice import group_motions
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import Rows, TimeBlock, divide_into_blocks
from asbuilt.identification.result.torque_prediction import predict_in_spans
from asbuilt.identification.uncertainty.block_scatter import BlockScores
from asbuilt.identification.uncertainty.uncertainty import (
    FEWEST_BLOCKS,
    estimate_scatter,
    unit_variance,
)
from asbuilt.scaled import Scaled
from asbuilt.tables import round_with_error


@dataclass(frozen=True, slots=True, eq=False)
class DelaySolution:
    """Hold increments (m,) [s] of delays and their covariance (m, m), infinite if undetermined.

    `follows` (p, m) is the change of the base parameters per delay.
    """

    increments: Array
    covariance: Array
    follows: Array
    n_blocks: int

    @property
    def std_errors(self) -> Array:
        """Standard errors [s], (m,); infinite where a delay is undetermined."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class DelayColumns:
    """Hold the normal equations of an estimate with a delay of each recording and joint, by block.

    Joint k has two columns: k for the rate of its torque, n + k for the rate of its friction.
    `normal` (B, r + 2 n + 1, r + 2 n + 1) has the products of the columns in coordinates
    `beta = S x`, S (p, r) the inverse root of the estimate, of these and of the residual, joints
    weighted. Only what is read is filled: above the diagonal, without the square of the residual.
    `place` (B,) is the number of each block's recording among R; `n_rows` torques have residuals
    of this `variance`.
    """

    normal: Array
    place: Array
    root: Array
    blocks: tuple[TimeBlock, ...]
    n_rows: int
    variance: float

    @property
    def grams(self) -> Array:
        """The normal equations of the base parameters alone, (B, r, r)."""
        r = self.root.shape[1]
        return self.normal[:, :r, :r]

    @cached_property
    def _known(self) -> Scaled:
        return Scaled(self.grams.sum(axis=0))

    @cached_property
    def _groups(self) -> list[Indices]:
        """Blocks in groups of like motion."""
        return group_motions(self.grams, np.array([block.n_samples for block in self.blocks]))

    def increments(self, shares: Array) -> Array:
        """Return the delays (m,) [s] that lower the residual most, 0 for undetermined ones."""
        return self._solved(shares).increments(shares.shape[-1])

    def solve(self, shares: Array, *, textbook: bool = False) -> DelaySolution:
        """Return the delays that lower the residual most, and what they add to other errors.

        `shares` (R, 2 n, m) are the delays of each recording and column per free delay. With `C'`
        the columns projected off all others, the covariance is `(C'^T C')^-1`, or that from time
        blocks if it is larger. Theirs counts, as in `estimate_block_uncertainty`, that base
        parameters absorb residuals too and that residuals outlast a block. The base parameters
        follow by `-(W^T W)^-1 W^T C` (Frisch and Waugh, Econometrica 1, 1933).
        """
        fit = self._solved(shares)
        m = shares.shape[-1]
        inverse = fit.root @ fit.root.T
        if fit.free.size and not textbook and len(self.blocks) >= FEWEST_BLOCKS:
            # Correlations stay those of the fit; few blocks determine variances alone.
            swell = np.sqrt(np.maximum(self._variance(fit) / np.diag(inverse), 1.0))
            inverse = inverse * np.outer(swell, swell)
        covariance = np.diag(np.full(m, np.inf))
        covariance[np.ix_(fit.free, fit.free)] = inverse
        follows = np.zeros((len(self.root), m))
        follows[:, fit.free] = -self.root @ fit.moved
        return DelaySolution(fit.increments(m), covariance, follows, len(self.blocks))

    def _solved(self, shares: Array) -> _Solved:
        """Return the fit of base parameters and delays together, by elimination."""
        spread = shares[self.place]
        r = self.root.shape[1]
        grams = self.grams
        # Contiguous, by which the order of sums in `einsum` does not depend on the other parts.
        across, between, late = map(
            np.ascontiguousarray,
            (self.normal[:, :r, r:-1], self.normal[:, r:-1, r:-1], self.normal[:, r:-1, -1]),
        )
        A = np.einsum("brk,bkm->brm", across, spread)
        D = np.einsum("bkl,bkj,bjm->blm", spread, between, spread, optimize=True)
        of_delay = np.einsum("bkm,bk->bm", spread, late)
        moved = self._known.solve(A.sum(axis=0))
        whole = D.sum(axis=0)
        # Schur complement: what of the columns of delays the base parameters cannot imitate.
        left = whole - moved.T @ grams.sum(axis=0) @ moved
        # Squared part of a delay's column outside all others below which it is undetermined.
        free = np.flatnonzero(
            np.diag(left) > 1e-9 * np.maximum(np.diag(whole), np.finfo(np.float64).tiny)
        )
        A = A[..., free]
        D = D[:, free][..., free]
        of_delay = of_delay[:, free]
        moved = moved[:, free]
        root = np.linalg.cholesky(np.linalg.inv(left[np.ix_(free, free)]))
        grams = np.block([[grams, A], [A.transpose(0, 2, 1), D]])
        scores = np.hstack([self.normal[:, :r, -1], of_delay])
        total = scores.sum(axis=0)
        x = root @ root.T @ (total[r:] - moved.T @ total[:r])
        solution = np.append(self._known.solve(total[:r] - A.sum(axis=0) @ x), x)
        return _Solved(grams, scores, solution, moved, root, free)

    def _variance(self, found: _Solved) -> Array:
        """Return the variances of delays from time blocks."""
        whitened = self._known.inverse_root
        m = found.free.size
        r = whitened.shape[1]
        # Inverse root of base parameters and delays together: lower right that of the delays.
        whole = np.block([[whitened, -found.moved @ found.root], [np.zeros((m, r)), found.root]])
        data = BlockScores(
            whole.T @ found.grams @ whole,
            (found.scores - found.grams @ found.solution) @ whole,
            self.blocks,
            self._groups,
            self.n_rows,
            self.variance,
        )
        return estimate_scatter(data, whole[-m:]).variance


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """Hold normal equations of base parameters and the m delays `free`, by block, and the solution.

    `moved` (r, m) is the regression of the columns of delays on the others, `root` (m, m) the
    inverse root of what it leaves.
    """

    grams: Array
    scores: Array
    solution: Array
    moved: Array
    root: Array
    free: Indices

    def increments(self, m: int) -> Array:
        """Return all m delays, those that are not free 0."""
        every = np.zeros(m)
        every[self.free] = self.solution[len(self.moved) :]
        return every


@dataclass(frozen=True, slots=True, eq=False)
class DelayErrors:
    """Hold what estimated delays add to the covariance (p, p) of base parameters.

    `shift` (p,) is what the parameters would move by if no delay were applied.
    """

    covariance: Array
    shift: Array


def estimate_delay_errors(
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
    # Recordings that were given one delay with one error share it; stated delays have no errors.
    free: dict[tuple[int, float, float], int] = {}
    shared = list[tuple[int, int, int]]()
    for r, batch in enumerate(samples):
        for k, (delay, error) in enumerate(zip(batch.delay, batch.delay_errors, strict=False)):
            shared.append((r, k, free.setdefault((k, delay, error), len(free))))
    if not free:
        return None
    shares = np.zeros((len(samples), 2 * n, len(free)))
    for r, k, place in shared:
        # One delay belongs to all joints of its recording; several are one a joint.
        joints = slice(n) if len(samples[r].delay_errors) == 1 else slice(k, k + 1)
        shares[r, joints, place] = 1.0
    columns = build_delay_columns(model, base, estimate, samples, block_seconds=block_seconds)
    solved = columns.solve(shares, textbook=textbook)
    applied, known = (np.array([key[part] for key in free]) for part in (1, 2))
    determined = np.isfinite(np.diag(solved.covariance))
    # Where the delay was estimated otherwise with a larger error, that one counts.
    swell = np.maximum(known[determined] / np.sqrt(np.diag(solved.covariance)[determined]), 1.0)
    V = solved.covariance[np.ix_(determined, determined)] * np.outer(swell, swell)
    follows = solved.follows[:, determined]
    covariance = np.asarray(follows @ V @ follows.T)
    return DelayErrors(covariance, np.asarray(-follows @ applied[determined]))


@use_one_blas_thread()
def build_delay_columns(
    model: RobotModel,
    base: BaseParameters,
    estimate: Estimate,
    samples: Sequence[Samples],
    *,
    block_seconds: float | None = None,
    rows: Rows | None = None,
) -> DelayColumns:
    """Return the normal equations of an estimate with a delay of each recording and joint.

    `rows` are the rows of the samples, if they are at hand.
    """
    rows = Rows(model, base, samples, block_seconds) if rows is None else rows
    root = estimate.solution.inverse_root
    weights = estimate.weights
    n = model.n_joints
    r = root.shape[1]
    every_normal = list[Array]()
    places = list[int]()
    blocks = list[TimeBlock]()
    every = zip(rows, rows.roots(), strict=True)
    for place, batch in enumerate(samples):
        rates = _derive_torque_rates(model, base, estimate.beta, batch)
        for part in divide_into_blocks(model, [batch], block_seconds):
            late = np.array([part.filtered(rate.__getitem__) for rate in rates])
            normal = np.zeros((r + 2 * n + 1,) * 2)
            block, roots = next(every)
            seen = list[Array]()
            for k, (columns, support) in enumerate(zip(block.rows, rows.support, strict=True)):
                turned = weights[k] * root[support].T
                # A torque logged late lacks its rate: minus.
                c = -weights[k] * late[:, k]
                e = weights[k] * (columns[-1] - estimate.beta[support] @ columns[:-1])
                # Columns r + k and r + n + k; the stop leaves out the residual's.
                both = slice(r + k, -1, n)
                seen.append(turned @ roots[k].T)
                normal[:r, [r + k, r + n + k, -1]] += turned @ (columns[:-1] @ np.vstack([c, e]).T)
                normal[both, both] += c @ c.T
                normal[both, -1] += c @ e
            together = np.hstack(seen)
            normal[:r, :r] = together @ together.T
            every_normal.append(normal)
            places.append(place)
            blocks.append(part.time)
    n_rows = sum(block.n_samples for block in blocks) * int(np.count_nonzero(weights))
    return DelayColumns(
        np.array(every_normal),
        np.array(places),
        root,
        tuple(blocks),
        n_rows,
        unit_variance(estimate),
    )


def _derive_torque_rates(
    model: RobotModel, base: BaseParameters, beta: Array, samples: Samples
) -> Array:
    """Return the rates of torque and friction [N m/s], (2, N, n)."""
    rigid, torque = np.zeros((2, *samples.q.shape))
    for span, *parts in predict_in_spans(model, base, beta, samples):
        rigid[span], torque[span] = parts
    rates = np.zeros((2, *torque.shape))
    # Differences do not cross gaps.
    for a, b in samples.segments:
        if b - a > 1:
            for rate, part in zip(rates, (torque, torque - rigid), strict=True):
                rate[a:b] = np.gradient(part[a:b], 1.0 / samples.rate, axis=0)
    return rates


@dataclass(frozen=True, slots=True)
class JointDelay:
    """Hold the delay of one joint [s]: estimate, standard error, and what was applied."""

    joint: str
    estimate: float
    std_error: float
    applied: float


@dataclass(frozen=True, slots=True)
class RecordingDelay:
    """Hold the time [s] by which the torque of a recording is late against position.

    `estimate` and `std_error` are NaN if it was stated. `applied` was taken out of the torque, the
    mean over joints if `joints` have their own. `digest` is the fingerprint of the recording.
    """

    source: str
    digest: str
    estimate: float
    std_error: float
    applied: float
    joints: tuple[JointDelay, ...] = ()

    @property
    def delays(self) -> tuple[float, ...]:
        """What was applied [s], one number or one per joint; empty for none."""
        applied = tuple(joint.applied for joint in self.joints) or (self.applied,)
        return applied if any(applied) else ()

    @property
    def errors(self) -> tuple[float, ...]:
        """Standard errors of what was estimated and applied [s]; empty for none."""
        if not self.delays or np.isnan(self.estimate):
            return ()
        return tuple(joint.std_error for joint in self.joints) or (self.std_error,)

    @property
    def text(self) -> str:
        """Estimate and standard error in ms, as text."""
        if np.isnan(self.estimate):
            return f"{1e3 * self.applied:.4g} ms (stated)" if self.applied else "none"
        if not np.isfinite(self.std_error):
            return "undetermined (not applied)"
        shown = " +- ".join(round_with_error(1e3 * self.estimate, 1e3 * self.std_error))
        return f"{shown} ms{'' if self.applied else ' (not applied)'}"


def state_delay(recording: Recording, digest: str, delays: tuple[float, ...]) -> RecordingDelay:
    """Return a delay that was given, one number or one per joint [s]."""
    applied = float(np.mean(delays)) if delays else 0.0
    joints = zip(recording.joint_names, delays, strict=True) if len(delays) > 1 else ()
    return RecordingDelay(
        recording.source,
        digest,
        np.nan,
        np.nan,
        applied,
        tuple(JointDelay(name, np.nan, np.nan, delay) for name, delay in joints),
    )
