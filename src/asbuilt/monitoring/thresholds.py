"""Thresholds of the residual for a stated rate of false alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import nnls

from asbuilt.arrays import Array, Mask
from asbuilt.dynamics.momentum import lagged
from asbuilt.errors import RecordingError, UsageError
from asbuilt.findings import Cure
from asbuilt.monitoring.extremes import Tail, block_maxima, gumbel_level, tail_level
from asbuilt.monitoring.model_error import ModelError
from asbuilt.monitoring.observed import Observed

BLOCK = 1.0
"""Shortest block [s]; longer than the observer remembers and than most contacts last."""
SLOW = (0.01, 0.03, 0.1, 0.3)
"""Speeds, as shares of the top speed, below which friction may be in error; one is chosen."""
POSITIVE = ("level", "floor", "slow_speed")
NOT_NEGATIVE = ("slow_part", "fast", "top_speed", "velocity_error")
HALF = 0.5
"""Largest error of the mean of a torque that steps between two samples, per step."""
MOST = 0.5
"""Largest probability of an alarm in a block; beyond it a level lies within the noise."""
LEAST = 1e-3
"""Smallest floor of the scale, per RMS residual."""


@dataclass(frozen=True, slots=True, eq=False)
class Thresholds:
    """Hold limits of the residual of each joint: `level S + u / 2 + w`, S the scale of its errors.

    `S^2 = floor^2 + slow^2 phi + (fast qd)^2 + model^2`: a constant, friction near standstill with
    phi the lagged `exp(-(v / slow_speed)^2)` of the least speed v between samples, growth with
    speed, and the standard deviation of the predicted torque that follows from the covariance of
    the parameters. u is the lagged size `|tau_k - tau_(k-1)|` of the steps of torque: one at an
    unknown time between two samples has a mean there that is off by at most half of it. A contact
    raises its own threshold by less than half of what it adds to the residual. w is the lagged
    largest error of friction whose direction is unknown (`Observed.unknown_friction`).

    Parameters
    ----------
    joint_names
        The n joints.
    bandwidth
        Bandwidth of the observer [Hz].
    false_alarms_per_hour
        Rate for the whole robot; a joint has its n-th part.
    block_seconds, hours, rate
        Length of the blocks, and of the recordings that the levels were set on, and their sampling
        rate [Hz].
    level, floor, slow_part, fast, slow_speed, top_speed
        Per joint, (n,): level in scales, the parts of S [N m or N, per unit of speed for `fast`],
        and speeds [rad/s or m/s], the last the highest met.
    velocity_error
        Largest error of the velocities [rad/s or m/s] per joint, (n,); none given: 0.
    tails
        The tail of each joint's block maxima.
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
    velocity_error: Array = field(default_factory=lambda: np.zeros(0))
    tails: tuple[Tail, ...] = ()
    held_out: bool = True
    filtered: bool = False

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        if np.size(self.velocity_error) == 0:
            object.__setattr__(self, "velocity_error", np.zeros(n))
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
        return np.asarray(np.sqrt(square + model**2))

    def limit(
        self, qd: Array, slowness: Array, step: Array, unknown_friction: Array, model: Array
    ) -> Array:
        """Return the largest residual that is no alarm [N m or N], shape of `qd`."""
        return self.level * self.scale(qd, slowness, model) + HALF * step + unknown_friction

    def of_log(self, observed: Observed, error: ModelError) -> tuple[Array, Array]:
        """Return scale and limit (N, n) along a log."""
        before = velocities_before(observed)
        slowness = lagged(observed.share, self.slow(before, observed.qd))
        model = error.std(observed.q, observed.qd, observed.qdd)
        scale = self.scale(observed.qd, slowness, model)
        return scale, self.level * scale + bounded(observed)


def bounded(observed: Observed) -> Array:
    """Return what errors of known bounds may add to the residual (N, n) [N m or N]."""
    return HALF * observed.step + observed.unknown_friction


def sampling_rates(t: Array) -> Array:
    """Return the reciprocals of the positive steps of time [Hz]."""
    steps = np.diff(t)
    return np.asarray(1.0 / steps[steps > 0.0])


def least_speed(before: Array, qd: Array) -> Array:
    """Return the least speed between two velocities: 0 where the sign changes."""
    smaller = np.minimum(np.abs(before), np.abs(qd))
    return np.asarray(np.where(before * qd < 0.0, 0.0, smaller))


def velocities_before(observed: Observed) -> Array:
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
    (`tail_level`).
    Assumptions: the motions ahead are like those of the recordings, blocks are independent, and
    joints may alarm one at a time, so that their rates add up.

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
        the tail is that of a Gumbel distribution through the rest.
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
    names, n = tuple(joint_names), len(joint_names)
    _check_measured(logs, names)
    models = [error.std(log.q, log.qd, log.qdd) for log in logs]
    kept = [np.ones(len(log.t), dtype=bool) for log in logs]
    seconds = max(BLOCK, 5.0 / (2.0 * np.pi * bandwidth))
    hours = sum(float(log.t[-1] - log.t[0]) for log in logs) / 3600.0
    probability = float(-np.expm1(-false_alarms_per_hour / n * seconds / 3600.0))
    if probability > MOST:
        highest = float(-np.log1p(-MOST) * n * 3600.0 / seconds)
        raise UsageError(
            f"{false_alarms_per_hour:g} false alarms per hour are more than thresholds can be set"
            f" for; at most {highest:.0f} per hour are possible for {n} joints",
            value=false_alarms_per_hour,
            expected=highest,
        )
    for last in (held_out, True):
        parts = [_parts(j, logs, models, kept) for j in range(n)]
        made = Thresholds(
            joint_names=names,
            bandwidth=bandwidth,
            false_alarms_per_hour=false_alarms_per_hour,
            block_seconds=seconds,
            hours=hours,
            rate=float(np.median(np.concatenate([sampling_rates(log.t) for log in logs]))),
            level=np.ones(n),
            floor=np.array([part[0] for part in parts]),
            slow_part=np.array([part[1] for part in parts]),
            fast=np.array([part[2] for part in parts]),
            slow_speed=np.array([part[3] for part in parts]),
            top_speed=np.max([np.abs(log.qd).max(axis=0) for log in logs], axis=0),
            velocity_error=np.zeros(n) if velocity_error is None else velocity_error,
            held_out=held_out,
            filtered=filtered,
        )
        ratios = [
            np.maximum(np.abs(log.residual) - bounded(log), 0.0) / made.of_log(log, error)[0]
            for log in logs
        ]
        if last:
            break
        kept = [_quiet(log, ratio, seconds) for log, ratio in zip(logs, ratios, strict=True)]
    maxima = np.concatenate(
        [block_maxima(log.t, ratio, seconds) for log, ratio in zip(logs, ratios, strict=True)]
    )
    tails = tuple(tail_level(column, probability) for column in maxima.T)
    level = np.array([tail.level for tail in tails])
    if not held_out:
        level, tails = np.array([gumbel_level(column, probability) for column in maxima.T]), ()
    return replace(made, level=level, tails=tails)


def _check_measured(logs: Sequence[Observed], names: Sequence[str]) -> None:
    for name, *columns in zip(names, *(log.residual.T for log in logs), strict=True):
        if not any(column.any() for column in columns):
            raise RecordingError(
                f"the external torque of {name} is exactly 0 in every sample, so its errors are"
                " unknown",
                cure=Cure("give recordings of the real robot, as logged"),
            )


def _non_negative(columns: Array, target: Array) -> Array:
    """Return nonnegative coefficients of least squares, from the normal equations."""
    normal = columns.T @ columns
    root = np.linalg.cholesky(normal + 1e-12 * np.trace(normal) * np.eye(len(normal)))
    found: Array = nnls(root.T, np.linalg.solve(root, columns.T @ target))[0]
    return found


def _quiet(log: Observed, ratio: Array, seconds: float) -> Mask:
    """Return which samples lie in the quieter half of the blocks."""
    block = np.floor((log.t - log.t[0]) / seconds).astype(np.int64)
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    largest = np.maximum.reduceat(ratio.max(axis=1), starts)
    counts = np.diff(np.append(starts, len(block)))
    return np.repeat(largest <= np.median(largest), counts)


def _parts(
    j: int, logs: Sequence[Observed], models: Sequence[Array], kept: Sequence[Mask]
) -> tuple[float, float, float, float]:
    """Return floor, slow part, fast part and slow speed of joint j.

    They are the most likely for normal residuals of these scales, by weighted least squares of the
    squares; shares of the steps of torque and of the unknown friction are fitted beside them.
    """
    residual, speed, model, step, unknown = (
        np.concatenate([each[keep] for each, keep in zip(arrays, kept, strict=True)])
        for arrays in (
            [log.residual[:, j] for log in logs],
            [log.qd[:, j] for log in logs],
            [each[:, j] ** 2 for each in models],
            [log.step[:, j] for log in logs],
            [log.unknown_friction[:, j] for log in logs],
        )
    )
    size = float(np.sqrt(np.mean(residual**2)))
    squares, model = (residual / size) ** 2, model / size**2
    beside = np.column_stack([step, unknown]) / size
    top = float(np.abs(speed).max()) or 1.0
    least = [least_speed(velocities_before(log), log.qd) for log in logs]
    best: tuple[float, tuple[float, float, float, float]] | None = None
    for part in SLOW:
        slow_speed = part * top
        slowness = np.concatenate(
            [
                lagged(log.share, np.exp(-((speed_of[:, j : j + 1] / slow_speed) ** 2)))[keep, 0]
                for log, speed_of, keep in zip(logs, least, kept, strict=True)
            ]
        )
        columns = np.column_stack([np.ones(len(squares)), slowness, (speed / top) ** 2, beside**2])
        variance = np.ones(len(squares))
        for _ in range(6):
            found = _non_negative(columns / variance[:, None], (squares - model) / variance)
            found[0] = max(found[0], LEAST**2)
            variance = columns @ found + model
        cost = float(np.sum(np.log(variance) + squares / variance))
        if best is None or cost < best[0]:
            a, b, c = (size * np.sqrt(found[:3])).tolist()
            best = cost, (a, b, c / top, slow_speed)
    assert best is not None
    return best[1]
