"""Torque of a position servo from its command and positions, and samples that determine its law."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array, Mask, find_finite_rows
from asbuilt.dynamics.drives.position_servo import PER_JOINT, PositionServo
from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording, find_advancing_rows, spread_over_joints
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

    from asbuilt.experiment.logs.reading_options import ReadingOptions
    from asbuilt.experiment.logs.sheet import RecordingSheet

FEWEST = 4
"""Samples of a command below which it has no curve."""
TICK = 1e-3
"""Period [s] in which a servo, as simulated, compares its control error with the one before."""
DROOP = 1.0 / 24.0
"""Outer weight of the filter `[w, 1 - 2 w, w]` whose response equals a held sample's,
`sinc(f T)`, to the fourth order in the frequency f."""


def hold_command(
    recording: Recording,
    delay: float = 0.0,
    curve: CommandCurve | None = None,
    derivative: int = 0,
) -> Array:
    """Return the command that acts at the times of the samples, or its derivative, shape (N, n).

    A command is held until the next. Below half the sampling rate that is a delay of half a period
    T and the response `sinc(f T)`; `delay` [s] comes in addition. If the recording has a servo that
    limits its goal, the goal takes the place of the command. A servo with a lead adds the rate of
    what acts, times the lead. A `curve` of the same recording spares making it.

    Examples
    --------
    >>> t = np.arange(0.0, 1.0, 0.01)
    >>> x = t[:, None]
    >>> late = hold_command(Recording(t=t, q=x, tau=x, command=x), delay=0.02)
    >>> round(float(t[50] - late[50, 0]), 6)
    0.025
    """
    servo = recording.servo
    goal = _sample_goal(recording, delay, derivative, curve)
    if servo is None or not np.any(servo.leads):
        return goal
    # A step of the command is a pulse of `TICK` in the rate, whose torque the limit cuts, so larger
    # steps count no more than one that reaches the limit. A limited goal has no steps.
    if not servo.limits_goal:
        recording = replace(recording, command=_with_small_steps(recording, servo))
        curve = None
    return goal + servo.leads * _sample_goal(recording, delay, derivative + 1, curve)


@dataclass(frozen=True, slots=True, eq=False)
class CommandCurve:
    """Hold the command of a recording as a curve, for any delay.

    `rows` (N,) are the samples that count, `t` their times and `spline` the curve through them.
    """

    rows: Mask
    t: Array
    spline: CubicSpline

    @classmethod
    def of(cls, recording: Recording) -> CommandCurve | None:
        """Return the curve of the command of a recording; None if it has too few samples."""
        rows = _select_samples(recording)
        t = recording.t[rows]
        x = _require_command(recording)[rows]
        return (
            cls(rows, t, _fit_spline(t, _weigh_neighbours(x, DROOP))) if t.size >= FEWEST else None
        )

    def held(self, delay: float, derivative: int) -> Array:
        """Return what is held for a period, or its derivative, shape (N, n)."""
        t = self.t
        at = t - 0.5 * float(np.median(np.diff(t))) - delay
        values = np.asarray(self.spline(np.clip(at, t[0], t[-1]), derivative))
        if derivative:
            values[(at < t[0]) | (at > t[-1])] = 0.0
        return values


def _with_small_steps(recording: Recording, servo: PositionServo) -> Array:
    """Return the command (N, n) with steps up to those whose rate, times the lead, is the limit."""
    command = _require_command(recording)
    with np.errstate(invalid="ignore", divide="ignore"):
        largest = np.array(servo.torque_limit) * TICK / (np.array(servo.kp) * servo.leads)
    most = np.nan_to_num(largest, nan=np.inf, posinf=np.inf)
    steps = np.diff(np.nan_to_num(command), axis=0)
    if np.all(np.abs(steps) <= most):
        return command
    small = np.cumsum(np.clip(steps, -most, most), axis=0)
    return np.where(np.isfinite(command), np.vstack([0.0 * small[:1], small]), np.nan)


def _sample_goal(
    recording: Recording, delay: float, derivative: int, curve: CommandCurve | None
) -> Array:
    command = _require_command(recording)
    out = np.full(command.shape, np.nan)
    if recording.servo is not None and recording.servo.limits_goal:
        rows = _select_samples(recording)
        t = recording.t[rows]
        if t.size >= FEWEST:
            goal = recording.servo.goal(t, command[rows])
            out[rows] = _filter_goal(*goal, t, delay, derivative)
        return out
    curve = curve or CommandCurve.of(recording)
    if curve is not None:
        out[curve.rows] = curve.held(delay, derivative)
    return out


def _require_command(recording: Recording) -> Array:
    if recording.command is None:
        raise ValueError("the recording has no command")
    return recording.command


def _select_samples(recording: Recording) -> Mask:
    """Return the samples with a command, at times that increase (N,)."""
    t = recording.t
    return find_advancing_rows(t, find_finite_rows(t, _require_command(recording)))


def _weigh_neighbours(x: Array, weight: float) -> Array:
    """Return x (N, n) after the filter `[w, 1 - 2 w, w]`; the ends are repeated."""
    padded = np.concatenate([x[:1], x, x[-1:]])
    return np.asarray(weight * (padded[:-2] + padded[2:]) + (1.0 - 2.0 * weight) * x)


def _fit_spline(t: Array, x: Array) -> CubicSpline:
    """Return the cubic spline through x (N, n)."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - light start

    return CubicSpline(t, x, axis=0)


def _filter_goal(fine: Array, goal: Array, t: Array, delay: float, derivative: int) -> Array:
    """Return the goal, or its derivative, below half the sampling rate, shape (K, n).

    The mean over a period T has the response `sinc(f T)` and nothing at the sampling rate; the
    filter `[-w, 1 + 2 w, -w]` undoes the response.
    """
    period = float(np.median(np.diff(t)))
    edges = np.append(fine, 2.0 * fine[-1] - fine[-2])
    means = np.diff(edges)[:, None] * goal
    sums = np.vstack([np.zeros(goal.shape[1]), np.cumsum(means, axis=0)])
    late = t - delay
    at = np.clip(late, t[0] + 0.5 * period, t[-1] - 0.5 * period)
    after, before = (
        np.stack([np.interp(at + half, edges, x) for x in sums.T], axis=1)
        for half in (0.5 * period, -0.5 * period)
    )
    values = _weigh_neighbours((after - before) / period, -DROOP)
    if derivative:
        values = np.asarray(_fit_spline(t, values)(t, derivative))
        values[(late < t[0]) | (late > t[-1])] = 0.0
    return np.asarray(values)


LOGGED = "tau_logged"
"""Extra quantity of a recording whose torque comes from its command: the torque that was logged."""


def drive_by_command(recording: Recording, servo: PositionServo) -> Recording:
    """Return the recording with the torque of a servo that follows its command.

    An unknown stiffness counts as 1 N m/rad, an unknown damping as 0, an unknown delay as 0: then
    the torque is a control error until the gains are identified. A torque that was logged becomes
    the extra quantity `LOGGED`.
    """
    known = replace(
        servo,
        kp=tuple(np.where(np.isfinite(servo.kp), servo.kp, 1.0)),
        kd=tuple(np.where(np.isfinite(servo.kd), servo.kd, 0.0)),
    )
    driven = replace(recording, servo=servo)
    held = hold_command(driven, servo.delay or 0.0)
    tau = known.torque(held, recording.q, differentiate_logged_positions(driven))
    extra = dict(recording.extra)
    if recording.servo is None and np.any(recording.tau):
        extra[LOGGED] = recording.tau
    return replace(recording, tau=tau, torque_source="command", servo=servo, extra=extra)


ABSENT = {"torque_limit": np.inf, "no_load_speed": np.inf, "goal_speed": np.inf, "lead": 0.0}
"""What a servo is taken to lack unless it is stated, as the number that says so."""


def drive_as_stated(
    recording: Recording, sheet: RecordingSheet, options: ReadingOptions
) -> Recording:
    """Return a recording with the torque of its command, where that is what drives the robot.

    Others stay as they are. Raises `RecordingError` if options describe a servo that they lack.
    """
    if recording.driving_command is not None:
        servo = _read_stated_servo(recording, sheet, options)
        if servo is not None:
            return drive_by_command(recording, servo)
    _refuse_idle_servo(recording, options)
    return recording


def _read_stated_servo(
    recording: Recording, sheet: RecordingSheet, options: ReadingOptions
) -> PositionServo | None:
    """Return the servo that options and sheet state; None if the torque itself was commanded.

    That is so where the sheet names torque columns, no command and no gains.
    """
    given = {
        name: getattr(sheet if getattr(options, name) is None else options, name)
        for name in PER_JOINT
    }
    stated = sheet.columns.command is not None or any(x is not None for x in given.values())
    if sheet.columns.torque is not None and not stated:
        return None
    numbers: dict[str, Any] = {}
    for name, each in given.items():
        values = spread_over_joints(recording, each, f"values of {name}")
        numbers[name] = tuple(np.where(np.isnan(values), ABSENT.get(name, np.nan), values).tolist())
    return PositionServo(**numbers)


def _refuse_idle_servo(recording: Recording, options: ReadingOptions) -> None:
    """Raise if options describe the servo of a recording that has none."""
    given = [name for name in PER_JOINT if getattr(options, name) is not None]
    problem = f"has torques in addition to its commands (source: {recording.torque_source})"
    cure = Cure("use its commands in their place", settings={"torque_source": "command"})
    if recording.command is None:
        problem = "has no commanded positions"
        cure = Cure('name their columns in a recording sheet: [columns] command = ["..."]')
    if given:
        raise RecordingError(
            f"{recording.source} {problem}, so that {', '.join(given)} of a servo would have no"
            " effect",
            cure=cure,
            file=recording.source,
            value=given,
        )


def differentiate_logged_positions(recording: Recording) -> Array:
    """Return velocities by central differences of the positions as logged, shape (N, n).

    They lack `T^2 / 6` times the third derivative, which the damping of a servo would turn into a
    delay of its torque. Where it is known, the filter `[-1/6, 4/3, -1/6]` leaves errors of fourth
    order.
    """
    damping = 0.0 if recording.servo is None else np.nan_to_num(recording.servo.kd)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.asarray(np.gradient(recording.q, recording.t, axis=0))
        found[1:-1] -= np.where(np.asarray(damping) > 0.0, np.diff(found, 2, axis=0) / 6.0, 0.0)
    return found


def find_saturated(recording: Recording) -> Mask:
    """Return where a joint's servo is at its torque limit, shape (N, n)."""
    if recording.servo is None:
        return np.zeros(recording.q.shape, dtype=np.bool_)
    limit = np.asarray(recording.servo.torque_limit)
    # Share of the torque limit from which the servo counts as saturated.
    slack = np.where(np.isfinite(limit), (1.0 - 0.999) * limit, 0.0)
    low, high = recording.servo.bounds(differentiate_logged_positions(recording))
    return np.asarray((recording.tau >= high - slack) | (recording.tau <= low + slack))


def drop_saturated(samples: Samples, recording: Recording) -> Samples:
    """Return the samples at which no servo is at its torque limit."""
    limited = np.any(find_saturated(recording), axis=1)
    if not np.any(limited):
        return samples
    half = 0.5 / samples.rate + 0.5 / recording.rate
    at = np.sort(recording.t[limited])
    near = np.searchsorted(at, samples.t - half)
    distance = at[np.minimum(near, at.size - 1)] - samples.t
    return samples.select(~(np.abs(distance) <= half))


def estimate_direction_speeds(recording: Recording, cutoff: float) -> tuple[float, ...]:
    """Return the speed of each joint below which its direction is unknown [rad/s or m/s].

    An encoder with steps s has errors up to s / 2; low-passed at f they are velocities up to
    `pi f s`. A position servo that stands still there holds any torque up to dry friction.

    Examples
    --------
    >>> t = np.arange(0.0, 2.0, 0.01)
    >>> q = np.round(np.sin(t) / 0.001)[:, None] * 0.001
    >>> round(estimate_direction_speeds(Recording(t=t, q=q, tau=q), cutoff=10.0)[0], 4)
    0.0314
    """
    changes = np.abs(np.diff(recording.q, axis=0))
    steps = []
    for change in changes.T:
        moved = change[np.isfinite(change) & (change > 1e-12 * np.nanmax(np.abs(recording.q)))]
        # Percentile of the changes of position that is taken as one step of an encoder.
        steps.append(float(np.percentile(moved, 1.0)) if moved.size else 0.0)
    return tuple(np.pi * cutoff * step for step in steps)


def drop_slow_rows(samples: Samples, recording: Recording, cutoff: float) -> Samples:
    """Return samples whose rows count only where the direction of a joint is known."""
    return replace(samples, slowest=estimate_direction_speeds(recording, cutoff))


def drop_unknown_directions(samples: Samples, recording: Recording, cutoff: float) -> Samples:
    """Return samples as `drop_slow_rows` if their torque follows from commands, else whole."""
    if not recording.has_computed_torque:
        return samples
    return drop_slow_rows(samples, recording, cutoff)
