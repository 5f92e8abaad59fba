"""Thresholds of the residual for a stated rate of false alarms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from asbuilt.apps.watch.extremes import (
    TAILS,
    block_maxima,
    divide_into_blocks,
    exponential_level,
    gumbel_level,
    select_largest,
    tail_level,
)
from asbuilt.apps.watch.observed import ModelError, Observed
from asbuilt.arrays import Array, Mask
from asbuilt.dynamics import apply_lag
from asbuilt.errors import RecordingError, UsageError
from asbuilt.findings import Cure

# Hold how levels are set.

# Shortest block [s]; longer than the observer remembers and than most contacts last
LEVEL_BLOCK = 1.0
# Largest probability of an alarm in a block; beyond it a level lies within the noise
LEVEL_MOST = 0.5
LEVEL_PARTS = 5  # Parts of the time of which each is measured in units that follow from the others
# Level of a joint whose residuals all lie within the bounds of known errors, in scales
LEVEL_WITHIN = 1.0
LEVEL_MOST_ROWS = 20000  # Samples that the scale is fitted to; a residual of 20 ms repeats itself


SLOW = (0.01, 0.03, 0.1, 0.3)
"""Speeds, as shares of the top speed, below which friction may be in error; one is chosen."""
UNIFORM = 1.0 / np.sqrt(3.0)
"""Standard deviation of an error within a bound, per bound."""
POSITIVE = ("level", "floor", "slow_speed", "spread")
NOT_NEGATIVE = ("slow_part", "fast", "top_speed", "velocity_error", "model_part")
HALF = 0.5
"""Largest error of the mean of a torque that steps between two samples, per step."""
MANY = 500
"""Blocks from which the ten largest are the largest 2 %: joints then have one tail together."""
LEAST = (0.001, 0.1, 0.3, 1.0)
"""Least floors of the scale, per RMS residual; one is chosen."""


@dataclass(frozen=True, slots=True, eq=False)
class Thresholds:
    """Hold limits of the residual of each joint: `level S + u / 2 + w`, S the scale of its errors.

    `S^2 = floor^2 + slow^2 phi + (fast qd)^2 + (part model)^2`: a constant, friction near
    standstill with phi the lagged `exp(-(v / slow_speed)^2)` of the least speed v between samples,
    growth with speed, and the standard deviation of the predicted torque that follows from the
    covariance of the parameters, times a part. u is the lagged size `|tau_k - tau_(k-1)|` of the
    steps of torque: one at an unknown time between two samples has a mean there that is off by at
    most half of it. A contact raises its own threshold by less than half of what it adds to the
    residual. w is the lagged largest error of friction whose direction is unknown
    (`Observed.unknown_friction`).

    Parameters
    ----------
    joint_names
        The n joints.
    bandwidth
        Bandwidth of the observer [Hz].
    false_alarms_per_hour
        Rate for the whole robot.
    block_seconds, hours, rate
        Length of the blocks, and of the recordings that the levels were set on, and their sampling
        rate [Hz].
    level, floor, slow_part, fast, slow_speed, top_speed
        Per joint, (n,): level in scales, the parts of S [N m or N, per unit of speed for `fast`],
        and speeds [rad/s or m/s], the last the highest met.
    velocity_error
        Largest error of the velocities [rad/s or m/s] per joint, (n,).
    model_part
        Share of the model's standard deviation in S, per joint, (n,).
    spread
        RMS residual per `deviation`, per joint, (n,): the scale that makes thresholds lowest is no
        standard deviation.
    held_out
        Whether the levels were set on recordings other than the one watched.
    filtered
        Whether velocities came from the causal filter and not from the log.

    Raises
    ------
    UsageError
        If a number is not finite or not positive, or an array has not n values.
    """

    joint_names: tuple[str, ...]
    bandwidth: float
    false_alarms_per_hour: float
    block_seconds: float
    hours: float
    rate: float
    level: Array
    floor: Array
    slow_part: Array
    fast: Array
    slow_speed: Array
    top_speed: Array
    velocity_error: Array
    model_part: Array
    spread: Array
    held_out: bool = True
    filtered: bool = False

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        for name in ("bandwidth", "false_alarms_per_hour", "block_seconds", "hours", "rate"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise UsageError(f"{name} of thresholds must be a positive number, got {value}")
        for name in (*POSITIVE, *NOT_NEGATIVE):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            least = np.finfo(float).tiny if name in POSITIVE else 0.0
            if values.shape != (n,) or not np.all(np.isfinite(values) & (values >= least)):
                sign = "positive" if name in POSITIVE else "at least 0"
                raise UsageError(
                    f"{name} of thresholds must be {n} numbers, {sign}, got {values.tolist()}"
                )

    def check_joints(self, names: Sequence[str]) -> None:
        """Raise `UsageError` unless the thresholds belong to these joints."""
        if tuple(names) != self.joint_names:
            raise UsageError(
                f"the thresholds belong to the joints {', '.join(self.joint_names)}, the robot has"
                f" {', '.join(names)}",
                cure=Cure("set the thresholds again for this robot"),
                value=list(names),
                expected=list(self.joint_names),
            )

    def slow(self, before: Array, qd: Array) -> Array:
        """Return `exp(-(v / slow_speed)^2)` of the least speed v between two samples (n,)."""
        return np.asarray(np.exp(-((least_speed(before, qd) / self.slow_speed) ** 2)))

    def scale(self, qd: Array, slowness: Array, model: Array) -> Array:
        """Return the scale S, shape of `qd`, from lagged slowness and model error."""
        square = self.floor**2 + self.slow_part**2 * slowness + (self.fast * qd) ** 2
        return np.asarray(np.sqrt(square + (self.model_part * model) ** 2))

    def limit(
        self, qd: Array, slowness: Array, step: Array, unknown_friction: Array, model: Array
    ) -> Array:
        """Return the largest residual that is no alarm [N m or N], shape of `qd`."""
        return self.level * self.scale(qd, slowness, model) + HALF * step + unknown_friction

    def scale_of_log(self, observed: Observed, model: Array) -> Array:
        """Return the scale S (N, n) along a log, from the model error."""
        slowness = apply_lag(observed.share, self.slow(delay_velocities(observed), observed.qd))
        return self.scale(observed.qd, slowness, model)

    def of_log(self, observed: Observed, error: ModelError) -> tuple[Array, Array]:
        """Return scale and limit (N, n) along a log."""
        scale = self.scale_of_log(observed, error.std(observed.q, observed.qd, observed.qdd))
        return scale, self.level * scale + bound_residual(observed)

    def covariance(self, observed: Observed, scale: Array, error: ModelError) -> Array:
        """Return the covariance (n, n) of the residuals of one sample without contact.

        The covariance of the model's part is propagated; the rest is independent from joint to
        joint. `observed` and `scale` (1, n) belong to the sample.
        """
        model = error.covariance(observed.q[0], observed.qd[0], observed.qdd[0])
        part = self.model_part * self.spread
        whole = (self.spread * deviation(observed, scale)[0]) ** 2
        shared = part[:, None] * model * part
        rest = np.maximum(whole - np.diag(shared), np.finfo(float).tiny)
        return np.asarray(shared + np.diag(rest))


def deviation(observed: Observed, scale: Array) -> Array:
    """Return `sqrt(S^2 + b^2 / 3)` (N, n) of a scale S and errors that are uniform within b."""
    return np.asarray(np.hypot(scale, UNIFORM * bound_residual(observed)))


def bound_residual(observed: Observed) -> Array:
    """Return what errors of known bounds may add to the residual (N, n) [N m or N]."""
    return HALF * observed.step + observed.unknown_friction


def sampling_rates(t: Array) -> Array:
    """Return the reciprocals of the positive steps of time [Hz]."""
    steps = np.diff(t)
    return np.asarray(1.0 / steps[steps > 0.0])


def least_speed(before: Array, qd: Array) -> Array:
    """Return the least speed between two velocities: 0 where the sign changes."""
    return np.asarray(np.where(before * qd < 0.0, 0.0, np.minimum(np.abs(before), np.abs(qd))))


def delay_velocities(observed: Observed) -> Array:
    """Return the velocities one sample earlier (N, n), where a lag starts its own."""
    before = np.vstack([observed.qd[:1], observed.qd[:-1]])
    return np.where(observed.share[:, None] < 0.0, observed.qd, before)


def set_thresholds(
    logs: Sequence[Observed],
    error: ModelError,
    joint_names: Sequence[str],
    *,
    bandwidth: float,
    velocity_error: Array | None = None,
    false_alarms_per_hour: float = 1.0,
    held_out: bool = True,
    filtered: bool = False,
) -> Thresholds:
    """Set thresholds from residuals without contact.

    Residuals, less what errors of known bounds may cause, are divided by their scale S, which
    removes most of what speed and pose change, and the largest of each block follow a tail
    (`tail_level`). Assumptions: the motions ahead are like the recorded ones, and blocks
    are independent.

    Parameters
    ----------
    logs
        Observed logs.
    error
        Error of the predicted torque.
    joint_names
        Names of the n joints.
    bandwidth
        Bandwidth of the observer [Hz].
    velocity_error
        Its largest error of the velocities (n,) [rad/s or m/s].
    false_alarms_per_hour
        Rate of false alarms for the whole robot.
    held_out
        Whether the logs are free of contact. If not, the upper half of the blocks is ignored, and
        the tail follows a Gumbel distribution through the rest.
    filtered
        Whether velocities came from the causal filter; they then must when watching.

    Raises
    ------
    UsageError
        If the rate is not positive, or so high that thresholds lie within the noise.
    RecordingError
        If the logs are too short.
    """
    if not (np.isfinite(false_alarms_per_hour) and false_alarms_per_hour > 0.0):
        raise UsageError(
            f"the rate of false alarms must be positive, got {false_alarms_per_hour} per hour"
        )
    names = tuple(joint_names)
    n = len(joint_names)
    _check_measured(logs, names)
    models = [error.std(log.q, log.qd, log.qdd) for log in logs]
    seconds = max(LEVEL_BLOCK, 5.0 / (2.0 * np.pi * bandwidth))
    probability = float(-np.expm1(-false_alarms_per_hour / n * seconds / 3600.0))
    if probability > LEVEL_MOST:
        highest = float(-np.log1p(-LEVEL_MOST) * n * 3600.0 / seconds)
        raise UsageError(
            f"{false_alarms_per_hour:g} false alarms per hour are more than thresholds can be set"
            f" for; at most {highest:.0f} per hour are possible for {n} joints",
            value=false_alarms_per_hour,
            expected=highest,
        )

    def fit(kept: Sequence[Mask]) -> tuple[Thresholds, list[Array], list[Array]]:
        """Return thresholds of level 1, their scales and what residuals have of them."""
        floor, slow_part, fast, model_part, slow_speed = _fit_scale(
            logs, models, kept, seconds, probability
        )
        made = Thresholds(
            joint_names=names,
            bandwidth=bandwidth,
            false_alarms_per_hour=false_alarms_per_hour,
            block_seconds=seconds,
            hours=sum(log.seconds for log in logs) / 3600.0,
            rate=float(np.median(np.concatenate([sampling_rates(log.t) for log in logs]))),
            level=np.ones(n),
            floor=floor,
            slow_part=slow_part,
            fast=fast,
            slow_speed=slow_speed,
            top_speed=np.max([np.abs(log.qd).max(axis=0) for log in logs], axis=0),
            velocity_error=np.zeros(n) if velocity_error is None else velocity_error,
            model_part=model_part,
            spread=np.ones(n),
            held_out=held_out,
            filtered=filtered,
        )
        scales = list(map(made.scale_of_log, logs, models))
        excesses = (np.maximum(np.abs(log.residual) - bound_residual(log), 0.0) for log in logs)
        return made, scales, list(map(np.divide, excesses, scales))

    kept = [np.ones(len(log.t), dtype=bool) for log in logs]
    made, scales, ratios = fit(kept)
    if not held_out:
        kept = [_find_quiet(log, ratio, seconds) for log, ratio in zip(logs, ratios, strict=True)]
        made, scales, ratios = fit(kept)
    made = replace(made, spread=_measure_spread(logs, scales, kept))
    maxima = np.concatenate(
        [block_maxima(log.t, ratio, seconds) for log, ratio in zip(logs, ratios, strict=True)]
    )
    if held_out:
        level = estimate_levels(maxima, false_alarms_per_hour * seconds / 3600.0)
    else:
        level = np.array([gumbel_level(column, probability) for column in maxima.T])
    # Where no residual leaves the bounds of known errors there is no tail to extrapolate.
    return replace(made, level=np.where(level > 0.0, level, LEVEL_WITHIN))


def _measure_spread(
    logs: Sequence[Observed], scales: Sequence[Array], kept: Sequence[Mask]
) -> Array:
    """Return the RMS residual of each joint (n,) per deviation."""
    ratios = [
        (log.residual / deviation(log, scale))[keep]
        for log, scale, keep in zip(logs, scales, kept, strict=True)
    ]
    return np.asarray(np.sqrt(np.mean(np.concatenate(ratios) ** 2, axis=0)))


def estimate_levels(maxima: Array, expected: float) -> Array:
    """Return levels (n,) of block maxima (B, n), for a number of false alarms per block.

    With `MANY` blocks the largest of all joints, each in units of the mean of its own largest block
    maxima, has one tail, which begins at its largest half percent. A tail per joint, for the n-th
    part of the rate, would lie n times farther beyond what the recordings show, and count joints
    twice that alarm together. With fewer blocks the ten largest of a joint reach into the bulk of
    its blocks, which says little of its tail compared with other tails; each then has its own.

    Units are errors of the same blocks: a joint whose largest maxima are small by chance has its
    level too low, and its blocks, in these units, would not show it. So the maxima that the tail is
    fitted to are in units from the other parts of the time.
    """
    n = maxima.shape[1]
    if len(maxima) < MANY:
        each = float(-np.expm1(-expected / n))
        return np.array([tail_level(column, each) for column in maxima.T])
    part = np.arange(len(maxima)) * LEVEL_PARTS // len(maxima)
    pooled = [
        (maxima[part == k] / _average_largest(maxima[part != k])).max(axis=1)
        for k in range(LEVEL_PARTS)
    ]
    level = tail_level(np.concatenate(pooled), float(-np.expm1(-expected)), TAILS[-1:])
    return _average_largest(maxima) * level


def _average_largest(maxima: Array) -> Array:
    """Return the mean of the largest maxima of each joint (n,)."""
    return np.maximum(
        [np.mean(select_largest(column)) for column in maxima.T], np.finfo(float).tiny
    )


def _check_measured(logs: Sequence[Observed], names: Sequence[str]) -> None:
    if not any(len(log.t) for log in logs):
        raise RecordingError(
            "no sample is left to set thresholds on",
            cure=Cure("give a longer recording without contact, of another motion than the fit's"),
        )
    for name, *columns in zip(names, *(log.residual.T for log in logs), strict=True):
        if not any(column.any() for column in columns):
            raise RecordingError(
                f"the external torque of {name} is exactly 0 in every sample, so its errors are"
                " unknown",
                cure=Cure("give recordings of the real robot, as logged"),
            )


def _solve_nonnegative(columns: Array, target: Array) -> Array:
    """Return nonnegative coefficients of least squares, from the normal equations."""
    normal = columns.T @ columns
    root = np.linalg.cholesky(normal + 1e-12 * np.trace(normal) * np.eye(len(normal)))
    return np.asarray(nnls(root.T, np.linalg.solve(root, columns.T @ target))[0])


def _find_quiet(log: Observed, ratio: Array, seconds: float) -> Mask:
    """Return which samples lie in the quieter half of the blocks."""
    starts, counts = divide_into_blocks(log.t, seconds)
    largest = np.maximum.reduceat(ratio.max(axis=1), starts)
    return np.repeat(largest <= np.median(largest), counts)


def _fit_scale(
    logs: Sequence[Observed],
    models: Sequence[Array],
    kept: Sequence[Mask],
    seconds: float,
    probability: float,
) -> Array:
    """Return floor, slow part, fast part, model part and slow speed of the joints, (5, n)."""
    seen = np.stack(
        [
            np.concatenate([array[keep] for array, keep in zip(arrays, kept, strict=True)])
            for arrays in (
                [log.residual for log in logs],
                [log.qd for log in logs],
                models,
                [log.step for log in logs],
                [log.unknown_friction for log in logs],
            )
        ]
    )
    starts = _find_block_starts(logs, kept, seconds)
    least = [least_speed(delay_velocities(log), log.qd) for log in logs]

    def fit_joint(j: int) -> tuple[float, ...]:
        def find_slowness(slow_speed: float) -> Array:
            return np.concatenate(
                [
                    apply_lag(log.share, np.exp(-((speeds[:, [j]] / slow_speed) ** 2)))[keep, 0]
                    for log, speeds, keep in zip(logs, least, kept, strict=True)
                ]
            )

        return _fit_parts(seen[:, :, j].copy(), find_slowness, starts, probability)

    return np.transpose([fit_joint(j) for j in range(seen.shape[2])])


def _fit_parts(
    seen: Array,
    find_slowness: Callable[[float], Array],
    starts: NDArray[Any],
    probability: float,
) -> tuple[float, ...]:
    """Return floor, slow part, fast part, model part and slow speed of a joint.

    For each slow speed and least floor they are the most likely for normal residuals of these
    scales, by weighted least squares of the squares; shares of the steps of torque and of the
    unknown friction are fitted as well. Of these the one counts that makes thresholds lowest:
    the geometric mean of `level S` with the level that block maxima exceed at the probability, if
    their tail is exponential. The most likely scale alone is not it: where it is too small, a few
    samples would raise the level everywhere. `seen` (5, N) are residual, speed, standard deviation
    of the model, steps of torque and unknown friction.
    """
    residual, speed, model, step, unknown = seen
    size = float(np.sqrt(np.mean(residual**2)))
    top = float(np.abs(speed).max()) or 1.0
    excess = np.maximum(np.abs(residual) - HALF * step - unknown, 0.0) / size
    few = slice(None, None, max(1, len(residual) // LEVEL_MOST_ROWS))
    extra = np.column_stack([step, unknown]) / size
    costs = []
    parts = []
    for share in SLOW:
        columns = np.column_stack(
            [
                np.ones(len(speed)),
                find_slowness(share * top),
                (speed / top) ** 2,
                (model / size) ** 2,
            ]
        )
        whole = np.column_stack([columns, extra**2])[few]
        for floor in LEAST:
            found = _fit_variances(whole, (residual[few] / size) ** 2, floor)
            scale = np.sqrt(columns @ found[:4])
            level = exponential_level(np.maximum.reduceat(excess / scale, starts), probability)
            costs.append(np.log(max(level, np.finfo(float).tiny)) + np.mean(np.log(scale)))
            a, b, c, d = np.sqrt(found[:4]).tolist()
            parts.append((size * a, size * b, size * c / top, d, share * top))
    return parts[int(np.argmin(costs))]


def _fit_variances(columns: Array, squares: Array, floor: float) -> Array:
    """Return coefficients of the columns of a variance, the first at least `floor**2`."""
    variance = np.ones(len(squares))
    found = np.zeros(columns.shape[1])
    for _ in range(6):
        found = _solve_nonnegative(columns / variance[:, None], squares / variance)
        found[0] = max(found[0], floor**2)
        variance = columns @ found
    return found


def _find_block_starts(
    logs: Sequence[Observed], kept: Sequence[Mask], seconds: float
) -> NDArray[Any]:
    """Return the first rows of the blocks of the samples kept of all logs."""
    blocks = [
        np.floor((log.t - log.t[0]) / seconds)[keep] for log, keep in zip(logs, kept, strict=True)
    ]
    number = np.repeat(np.arange(len(logs)), [len(block) for block in blocks])
    both = np.column_stack([number, np.concatenate(blocks)])
    return np.flatnonzero(np.any(np.diff(both, axis=0, prepend=-1.0) != 0.0, axis=1))
