"""Delay of the torque against position, from recordings with a plain weighted fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import fdtrc

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, DriveSet, find_base_parameters
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.errors import AsbuiltError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.bodies.cad_prior import build_cad_prior, design_values
from asbuilt.identification.estimators.consistent_fit import fit_toward_cad
from asbuilt.identification.estimators.held_out_choice import (
    group_different_motions,
    measure_held_out_errors,
)
from asbuilt.identification.estimators.least_squares import FixedPoint, fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.rows import Rows
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
    reduce_rows,
)
from asbuilt.identification.uncertainty.delay_errors import (
    DelayColumns,
    DelaySolution,
    build_delay_columns,
)
from asbuilt.statistics import estimate_mean_error

Prepare = Callable[[Array], Sequence["Samples"]]
"""Returns the samples of R recordings whose torques are shifted back by delays (R, n) [s]."""


HELPFUL = 2.0
"""Standard errors by which the error on other motions must fall: own choice.

In ten sets of recordings of four real robots, whole and two thirds of each, delays of 18 to 62 ms
exceeded 2 of their own standard errors. Eight sets fail here; applied, those delays change the
error on other recordings by -18 to +51 %, by +16 % on average. The other two, of the fast log of
the Med 7, lower it by 1 and 2 %.
"""


def measure_delay_relief(
    model: RobotModel,
    base: BaseParameters,
    weights: Array,
    before: Sequence[Samples],
    after: Sequence[Samples],
) -> tuple[float, float] | None:
    """Return the log of the fall of the squared error on other motions, and its standard error.

    Links near CAD (or plain least squares, where CAD has no masses) are fitted to all groups of
    motion but one and predict that one, with torques as logged and shifted back. None if there are
    fewer than three groups, which prove nothing, or no fit to one of them.

    Parameters
    ----------
    model, base
        The robot and base parameters of the fits.
    weights
        Weights of the joints (n,).
    before, after
        Samples with torques as logged, and shifted back.
    """
    as_logged, shifted = (accumulate_stream(model, base, samples) for samples in (before, after))
    with use_one_blas_thread():
        groups = group_different_motions(shifted, weights)
        # Groups below which held-out errors have no usable standard error.
        if len(groups) < 3 or as_logged.n_blocks != shifted.n_blocks:
            return None
        try:
            errors = [
                measure_held_out_errors(each, partial(_fit_part, model, weights), groups)[0]
                @ weights**2
                for each in (as_logged, shifted)
            ]
        except (AsbuiltError, np.linalg.LinAlgError):
            return None
    tiny = np.finfo(np.float64).tiny
    relief = np.log(np.maximum(errors[0], tiny) / np.maximum(errors[1], tiny))
    return float(relief.mean()), estimate_mean_error(relief)


def _fit_part(model: RobotModel, weights: Array, part: SquareRootInformation) -> Array:
    if model.has_every_mass:
        prior = build_cad_prior(model, part.base.drive)
        # Weight of CAD in the fits, as for a base tilt: ten times the usual design effect.
        return fit_toward_cad(part, prior, weight=100.0, weights=weights).beta
    return fit_least_squares(part, weights=weights, prior=design_values(model, part.base)).beta


SIGNIFICANT = 2.0
"""Standard errors that a delay must exceed to be applied."""
CERTAIN = 5e-3
"""Standard error [s] below which that is enough; else it must also predict other motions better.

On the logs of four real robots friction lags by 13 to 75 ms, and the delays that rest on what is
left have standard errors of 8 to 60 ms, against 0.1 to 3 ms of virtual robots whose torque is late.
"""
UNEQUAL = 1e-3
"""Probability of equal recordings, or joints, below which they have delays of their own."""
OF_ONE_JOINT = 3.0
"""Largest lag of friction of one joint, in the mean of all (own choice: 2.8 on the LWR4+)."""
MOST_STEPS = 10
"""Most steps of a search."""
SETTLED = 2e-5
"""Increment [s] below which a delay has converged."""
LONGEST_STEP = 0.05
"""Largest increment, in periods of the cutoff, for which the derivative holds."""
FARTHEST = 0.3
"""Delay [s] beyond which the search has failed."""


@dataclass(frozen=True, slots=True, eq=False)
class DelayEstimate:
    """Hold the delays of R recordings with n joints.

    Attributes
    ----------
    estimates, std_errors
        One delay per recording [s], (R,), all the same unless recordings differ; errors are
        infinite where a delay is undetermined.
    lag, lag_error
        How much later friction is than the other torques, mean over joints [s].
    certain
        Whether a recording alone would tell its delay to 5 ms, (R,); where they share one, whether
        half of them would.
    joint_estimates, joint_errors
        Delays of the joints [s], (R, n); None unless the recordings ask for them.
    helps
        Whether the delays lower the error on other motions; None if that was not asked.
    """

    estimates: Array
    std_errors: Array
    lag: float
    lag_error: float
    certain: Mask
    joint_estimates: Array | None = None
    joint_errors: Array | None = None
    helps: bool | None = None

    @property
    def applied(self) -> Mask:
        """Which delays are applied, (R,): above 2 standard errors, and certain or helpful."""
        sure = np.abs(self.estimates) > SIGNIFICANT * self.std_errors
        return sure & (self.certain | bool(self.helps))


def find_delays(
    model: RobotModel,
    prepare: Prepare,
    *,
    drive: DriveSet,
    count: int,
) -> DelayEstimate:
    """Estimate the delay of the torque: of recordings if they differ, and of joints if these do.

    The delay is a column `-d(W beta)/dt` of a weighted least squares fit of all recordings; torques
    are shifted by the estimate and the fit is repeated until it stays (Gauss-Newton). Friction that
    lags velocity (presliding, lubricant) looks like a delay, though rigid bodies do not lag. So the
    change of the delay if friction has a lag of its own counts as error. If that lag exceeds 2
    standard errors, each joint has one, and the delay rests on rigid bodies alone. Delays that a
    recording by itself tells to 5 ms at best are applied only if groups of different motion that
    are held out in turn are predicted better.

    Parameters
    ----------
    model
        The robot.
    prepare
        Prepares the recordings with given delays.
    drive
        Linear drive terms of the fit, friction among them.
    count
        Number of recordings R.
    """
    fits = _Fits(model, prepare, drive, count)
    n = model.n_joints
    # All joints of a recording share one delay, and all recordings unless they differ.
    each = _build_joint_shares(count, n).reshape(count, 2 * n, count, n).sum(axis=3)
    common = each.sum(axis=2, keepdims=True)
    together, columns = fits.settle(np.zeros(count), common)
    if count > 1 and not _are_alike(columns.solve(each)):
        common = each
        together, columns = fits.settle(together, common)
    lags = _build_friction_shares(count, n)
    m = common.shape[2]
    delays = together
    further = np.zeros((count, 2 * n, 0))
    mean_lag = columns.solve(np.concatenate([common, lags.sum(axis=2, keepdims=True)], axis=2))
    moved = mean_lag.increments[:m]
    if abs(mean_lag.increments[-1]) > SIGNIFICANT * mean_lag.std_errors[-1]:
        further = lags
        delays, columns = fits.settle(together, np.concatenate([common, further], axis=2), m)
        moved = (delays - together)[:m]

    def evaluate_errors(shares: Array) -> Array:
        solved = columns.solve(np.concatenate([shares, further], axis=2))
        return np.hypot(solved.std_errors[: shares.shape[2]], moved)

    std_errors = evaluate_errors(common)
    alone = std_errors if m == count else evaluate_errors(each)
    std_errors = np.broadcast_to(std_errors, (count,))
    # Many recordings do not average away what imitates a delay: what one could say alone counts.
    certain = alone < CERTAIN
    if m < count:
        certain = np.full(count, np.median(alone) < CERTAIN)
    std_errors = np.where(np.abs(delays) < FARTHEST, std_errors, np.inf)
    lag = float(mean_lag.increments[-1])
    lag_error = float(mean_lag.std_errors[-1])
    of_joints = _estimate_joint_delays(fits, delays, abs(lag) + SIGNIFICANT * lag_error)
    if of_joints is None:
        sure = np.abs(delays) > SIGNIFICANT * std_errors
        doubtful = np.any(sure & ~certain)
        shifts = np.where(sure, delays, 0.0)
    else:
        doubtful = np.median(of_joints[1]) >= CERTAIN
        shifts = of_joints[0]
    helps = fits.predict_better(shifts) if doubtful else None
    joints, errors = (None, None) if of_joints is None or helps is False else of_joints
    return DelayEstimate(delays, std_errors, lag, lag_error, certain, joints, errors, helps)


class _Fits:
    """Fit recordings with delays; the latest normal equations are kept."""

    def __init__(self, model: RobotModel, prepare: Prepare, drive: DriveSet, count: int) -> None:
        self.model = model
        self.count = count
        self._prepare = prepare
        self._base = find_base_parameters(model, drive)
        self._design = design_values(model, self._base)
        self._known: Rows | None = None
        self._columns: _Columns | None = None
        self.longest = np.inf

    def predict_better(self, delays: Array) -> bool:
        """Return whether torques shifted back by delays are predicted better on other motions."""
        after = self._shift_samples(delays)
        before = self._shift_samples(np.zeros(self.count))
        weights = self._fit_plain(self._take_rows(after)).weights
        relief = measure_delay_relief(self.model, self._base, weights, before, after)
        return relief is not None and relief[0] > HELPFUL * relief[1]

    def _shift_samples(self, delays: Array) -> Sequence[Samples]:
        of_recordings = delays.reshape(self.count, -1)
        return self._prepare(np.broadcast_to(of_recordings, (self.count, self.model.n_joints)))

    def _take_rows(self, samples: Sequence[Samples]) -> Rows:
        """Return the rows of samples; only their torque is new where the motion is as before."""
        if self._known is None or not self._known.take_torque(samples):
            self._known = Rows(self.model, self._base, samples)
            self._columns = None
        return self._known

    def _fit_plain(self, rows: Rows) -> Estimate:
        """Return the plain weighted fit."""
        if self._columns is not None:
            information = self._columns.with_torque(rows)
        else:
            information = reduce_rows(self._base, self.model.joint_names, rows.support, rows)
            if rows.are_kept:
                self._columns = _Columns.of(information, rows)
        return fit_least_squares(information, weights="joint", prior=self._design)

    def columns(self, delays: Array) -> DelayColumns:
        """Return the normal equations with torques shifted back by delays (R,) or (R, n)."""
        samples = self._shift_samples(delays)
        bands = [sample.parallel.cutoff for sample in samples if sample.parallel]
        self.longest = LONGEST_STEP / min(bands) if bands else LONGEST_STEP
        rows = self._take_rows(samples)
        estimate = self._fit_plain(rows)
        return build_delay_columns(self.model, self._base, estimate, samples, rows=rows)

    def settle(
        self, delays: Array, shares: Array, free: int | None = None
    ) -> tuple[Array, DelayColumns]:
        """Return the delays (R,) after which the residual falls no further.

        The first `free` columns of the shares are delays, one or R; None: all.
        """
        columns = self.columns(delays)
        ahead = FixedPoint()
        for _ in range(MOST_STEPS):
            step = np.broadcast_to(columns.increments(shares)[:free], (self.count,))
            # Each step leaves up to 0.7 of the error: friction that lags bends what is left.
            step = ahead.advance(delays, delays + step) - delays
            step = np.clip(step, -self.longest, self.longest)
            delays = delays + step
            if np.all(np.abs(step) < SETTLED) or np.any(np.abs(delays) > FARTHEST):
                break
            columns = self.columns(delays)
        return delays, columns


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """Hold `W_k^T = R^T Q^T` of every joint, with which another torque costs one product.

    `bases[k]` is Q^T (p_k, N), `triangles[k]` R (p_k, p_k).
    """

    information: SquareRootInformation
    bases: tuple[Array, ...]
    triangles: tuple[Array, ...]

    @classmethod
    def of(cls, information: SquareRootInformation, rows: Rows) -> _Columns:
        """Return the columns of rows that are kept, whose information this is."""
        (whole,) = rows.parts()
        pairs = [np.linalg.qr(each[:-1].T) for each in whole]
        return cls(information.together(), tuple(Q.T for Q, _ in pairs), tuple(R for _, R in pairs))

    def with_torque(self, rows: Rows) -> SquareRootInformation:
        """Return the information of the same motion with the torque that rows have now."""
        (whole,) = rows.parts()
        factors = []
        for each, basis, triangle in zip(whole, self.bases, self.triangles, strict=True):
            torque = each[-1]
            along = basis @ torque
            left = np.linalg.norm(torque - along @ basis)
            p = len(each) - 1
            factor = np.zeros((1, p + 1, p + 1))
            factor[0, : len(basis), :p] = triangle
            factor[0, : len(basis), p] = along
            factor[0, p, p] = left
            factors.append(factor)
        torque_sum = np.array([[each[-1].sum() for each in whole]])
        return replace(self.information, factors=tuple(factors), torque_sum=torque_sum)


def _estimate_joint_delays(fits: _Fits, delays: Array, lag: float) -> tuple[Array, Array] | None:
    """Return delays of the joints and their errors, (R, n) each, or None if they are alike.

    Friction lags by different times at different joints. So what the lag of a joint's friction
    changes counts as error, and delays that differ must do so by more than the largest lag of
    friction (`lag`) [s].
    """
    n = fits.model.n_joints
    count = fits.count
    columns = fits.columns(delays)
    each = _build_joint_shares(count, n)
    wide = np.repeat(delays[:, None], n, axis=1)
    for _ in range(MOST_STEPS // 2):
        step = np.clip(columns.increments(each).reshape(count, n), -fits.longest, fits.longest)
        wide = np.clip(wide + step, -FARTHEST, FARTHEST)
        columns = fits.columns(wide)
        if np.all(np.abs(step) < SETTLED):
            break
    solved = columns.solve(each)
    with_lags = columns.increments(np.concatenate([each, _build_friction_shares(count, n)], axis=2))
    moved = with_lags[: count * n] - solved.increments
    errors = np.hypot(solved.std_errors, moved).reshape(count, n)
    chance, spread = _test_equal_delays(wide, errors, solved.n_blocks)
    return None if chance > UNEQUAL or spread < OF_ONE_JOINT * lag else (wide, errors)


def _are_alike(solved: DelaySolution) -> bool:
    """Return whether recordings may have one delay: one logger wrote them.

    Delays found one by one are as many chances of a false one.
    """
    chance, _ = _test_equal_delays(
        solved.increments[None], solved.std_errors[None], solved.n_blocks
    )
    return chance > UNEQUAL


def _test_equal_delays(delays: Array, errors: Array, n_blocks: int) -> tuple[float, float]:
    """Return the probability of such differences along rows, and the least of the largest."""
    weight = errors**-2.0
    total = weight.sum(axis=1, keepdims=True)
    freedom = int(np.count_nonzero(weight)) - len(delays)
    if np.any(total == 0.0) or freedom < 1:
        return 1.0, 0.0
    off = delays - (weight * delays).sum(axis=1, keepdims=True) / total
    chi_square = float(np.sum(weight * off**2))
    chance = float(fdtrc(freedom, max(n_blocks - 1, 1), chi_square / freedom))
    return chance, float(np.max(np.abs(off) - SIGNIFICANT * errors))


def _build_joint_shares(count: int, n: int) -> Array:
    """Return the shares of one delay per recording and joint, (R, 2 n, R n)."""
    shares = np.zeros((count, 2 * n, count, n))
    r, k = np.indices((count, n))
    shares[r, k, r, k] = 1.0
    return shares.reshape(count, 2 * n, count * n)


def _build_friction_shares(count: int, n: int) -> Array:
    """Return the shares of one lag of friction per joint, (R, 2 n, n)."""
    return np.tile(np.eye(2 * n)[:, n:], (count, 1, 1))
