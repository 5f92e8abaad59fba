"""Deviations of a position servo from proportional-derivative control, searched in recordings.

A deadband of the control error, and a limit of the acceleration that the servo gives its goal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from typing import Any

import numpy as np

from asbuilt.arrays import Array, Indices, find_finite_rows
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.command.torque import hold_command
from asbuilt.experiment.recording import Recording
from asbuilt.identification.information.equations import Equations
from asbuilt.identification.information.rows import TimeBlock
from asbuilt.identification.servo.servo_rows import (
    CommandedMotion,
    block_variances,
    fit_robust_residual,
    logarithmic_error,
    reduce_servo_recordings,
    refine_minimum,
    sum_clusters,
    usual_variances,
)

# Say how a deadband is searched, and when it counts as found: own choices.

# DEADBAND_SMALLEST, DEADBAND_LARGEST, DEADBAND_RATIO: range of the width, in units of the root mean
# square of the control error of a typical joint, and ratio of neighbouring widths that are tried
DEADBAND_SMALLEST = 0.02
DEADBAND_LARGEST = 0.7
DEADBAND_RATIO = 2.0
DEADBAND_SIGMAS = 3.0  # Standard errors by which the cost of all joints must fall
DEADBAND_WORSE = 2.0  # Standard errors by which the cost of no joint may rise
DEADBAND_DETERMINED = 0.2  # Largest relative standard error of the width
# Relative error by the filters, in addition to noise: virtual arms differ by up to 0.6 %
DEADBAND_ACCURACY = 0.01
DEADBAND_HALF = 5  # Blocks together that are fitted or validated


# Say how a limit is searched, and when it counts as found: own choices.

# GOAL_SLOWEST, GOAL_FASTEST: range of the limit, in units of the largest acceleration that joints
# reached; a joint that resonates reaches more than its goal
GOAL_SLOWEST = 0.15
GOAL_FASTEST = 8.0
GOAL_RATIO = 1.5  # Ratio of neighbouring limits that are tried
# Largest change of the goal beyond a delay, in units of the control error, below which a limit is
# not distinguishable from none
GOAL_VISIBLE = 0.15
# Smallest likelihood ratio statistic, residuals taken as one per cluster of blocks: three standard
# errors
GOAL_SIGNIFICANCE = 9.0
GOAL_DETERMINED = 0.2  # Largest relative standard error


def fill_unknown(servo: PositionServo, **values: float) -> PositionServo:
    """Return the servo with these values where numbers of a name are unknown (NaN)."""
    filled: dict[str, Any] = {}
    for name, value in values.items():
        known = np.array(getattr(servo, name))
        filled[name] = tuple(np.where(np.isnan(known), value, known).tolist())
    return replace(servo, **filled)


def estimate_deadband(
    motions: Sequence[CommandedMotion], recordings: Sequence[Recording], late: float
) -> tuple[float, float]:
    """Return the deadband that recordings show [rad or m] and its standard error, or zeros.

    For each width `D(e) = W b + v qd + step du/dt` is fitted joint by joint to half of the time
    blocks, with everything free, and validated on the others, both ways. The residual counts
    relative to D(e), which scales as the torque does. Joints share the width: it counts only if
    the cost falls, and significantly rises at no joint, as friction that grows with the load, which
    resembles a deadband, would have it.

    `motions` belong to the recordings, whose command acts after `late` [s]. Joints whose deadband
    is known are left out.
    """
    servo = recordings[0].servo
    joints = np.flatnonzero(np.isnan(np.array(() if servo is None else servo.deadband)))
    if not joints.size:
        return 0.0, 0.0
    rates = [
        motion.rate(recording, late) for motion, recording in zip(motions, recordings, strict=True)
    ]

    def rows(width: float) -> Equations:
        driven = [
            replace(recording, servo=fill_unknown(recording.servo, deadband=width))
            for recording in recordings
            if recording.servo is not None
        ]
        return reduce_servo_recordings(motions, driven, late, rates)

    plain = rows(0.0)
    usual = usual_variances(plain, joints)

    # The refinement asks again for what the search has tried.
    @cache
    def costs(width: float) -> Array:
        return _validate_halves(rows(width), plain, joints, usual)

    best = 0.0
    lowest = float(np.sum(costs(0.0)))
    for width in _list_widths(plain, joints):
        cost = float(np.sum(costs(width)))
        # The cost has one minimum over the width: the first rise ends the search.
        if not cost < lowest:
            break
        best = width
        lowest = cost
    # Tested before the refinement, which costs as much as the search, and after it again.
    if best == 0.0 or not _is_better_at_joints(costs(0.0) - costs(best), plain):
        return 0.0, 0.0
    width = refine_minimum(costs, best, DEADBAND_RATIO, 2e-3)
    error = logarithmic_error(costs, width, plain)
    sure = error < DEADBAND_DETERMINED and _is_better_at_joints(costs(0.0) - costs(width), plain)
    return (width, width * float(np.hypot(error, DEADBAND_ACCURACY))) if sure else (0.0, 0.0)


def _list_widths(plain: Equations, joints: Indices) -> Iterator[float]:
    """Yield the widths to try, smallest first."""
    sizes = [np.sqrt(plain.of_joints[k][-1, -1] / max(plain.counts[k].sum(), 1)) for k in joints]
    width = DEADBAND_SMALLEST * float(np.median(sizes))
    while width < DEADBAND_LARGEST * float(np.median(sizes)):
        yield width
        width *= DEADBAND_RATIO


def _validate_halves(rows: Equations, plain: Equations, joints: Indices, usual: Array) -> Array:
    """Return the cost of each joint and block (n joints, B), fitted to the other half."""
    second = (np.arange(rows.n_blocks) // DEADBAND_HALF) % 2 == 1
    costs = np.zeros((joints.size, rows.n_blocks))
    for row, k in enumerate(joints.tolist()):
        shrunk = max(rows.of_joints[k][-1, -1] / plain.of_joints[k][-1, -1], 1e-300)
        # Blocks of one half are judged by the fit to the other, in stretches that share a pose.
        for here in (second, ~second):
            left = block_variances(rows, k, fit_robust_residual(rows, k, ~here)) / shrunk
            cost = np.nan_to_num(rows.counts[k] * np.log1p(left / usual[k]))
            costs[row, here] = cost[here]
    return costs


def _is_better_at_joints(fall: Array, rows: Equations) -> bool:
    """Whether costs (n joints, B) fall significantly in all, and rise at no joint."""
    sigmas = np.array([_count_sigmas(sum_clusters(joint_fall, rows)) for joint_fall in fall])
    return _count_sigmas(sum_clusters(fall.sum(axis=0), rows)) > DEADBAND_SIGMAS and bool(
        np.all(sigmas > -DEADBAND_WORSE)
    )


def _count_sigmas(parts: Array) -> float:
    """Return the sum of independent parts in its standard errors."""
    if parts.size < 2:
        return 0.0
    # Standard error of a sum: the root of n times the sample variance.
    spread = float(np.sqrt(np.sum((parts - parts.mean()) ** 2) * parts.size / (parts.size - 1)))
    return float(parts.sum()) / max(spread, 1e-300)


@dataclass(frozen=True, slots=True, eq=False)
class GoalLimit:
    """Hold a limit of the goal's acceleration [rad/s^2 or m/s^2] with its standard error.

    `acts` are the time blocks that it explains, in order of time.
    """

    acceleration: float
    std_error: float
    acts: tuple[TimeBlock, ...]


def average_limits(goals: Sequence[GoalLimit | None]) -> tuple[float, float]:
    """Return the weighted mean of limits and its standard error.

    Infinite and 0 if a recording shows none.
    """
    shown = [goal for goal in goals if goal is not None]
    # A servo has one limit: a recording that shows none refutes what others seem to show.
    if not shown or len(shown) < len(goals):
        return np.inf, 0.0
    weight = np.array([1.0 / goal.std_error**2 for goal in shown])
    mean = float(np.average([goal.acceleration for goal in shown], weights=weight))
    return mean, float(np.sum(weight) ** -0.5)


def find_goal_limit(
    recording: Recording,
    servo: PositionServo,
    reached: Array,
    rows: Callable[[PositionServo], Equations],
) -> GoalLimit | None:
    """Return the limit under which a recording fits best; None if it shows none.

    For each limit `goal - q = W b + v qd + step dgoal/dt` is fitted joint by joint, with everything
    free. The cost holds for residuals whose variance varies from block to block, with a bounded
    influence of each (`n log(1 + r / median)` for the mean square r of n rows), so that
    collisions do not count.

    Parameters
    ----------
    recording
        The recording.
    servo
        Its servo; a limit that is NaN is searched, one for all such joints.
    reached
        Largest acceleration of each joint (n,) [rad/s^2 or m/s^2].
    rows
        Returns the rows of the recording under a servo.
    """
    joints = np.flatnonzero(np.isnan(np.array(servo.goal_acceleration)))
    visible = _list_visible_limits(recording, servo, reached, joints)
    first = next(visible, None)
    if first is None:
        return None
    plain = rows(fill_unknown(servo, goal_acceleration=np.inf))
    usual = usual_variances(plain, joints)
    without = _evaluate_costs(plain, joints, usual)

    @cache
    def costs(limit: float) -> Array:
        return _evaluate_costs(rows(fill_unknown(servo, goal_acceleration=limit)), joints, usual)

    sums: dict[float, float] = {}
    for limit in chain([first], visible):
        sums[limit] = float(np.sum(costs(limit) - without))
        # Slower limits than two that are worse than none hinder the goal more still.
        if len(sums) > 1 and min([*sums.values()][-2:]) > 0.0:
            break
    best = min(sums, key=sums.__getitem__)
    if not _is_significant(without - costs(best), plain, joints):
        return None
    limit = refine_minimum(costs, best, GOAL_RATIO, 5e-3)
    error = logarithmic_error(costs, limit, plain)
    if not error < GOAL_DETERMINED:
        return None
    return GoalLimit(limit, limit * error, _find_acting_blocks(without - costs(limit), plain))


def _list_visible_limits(
    recording: Recording, servo: PositionServo, reached: Array, joints: Indices
) -> Iterator[float]:
    """Yield the limits in their range that change the goal beyond a delay, fastest first."""
    # Without commands or joints of unknown limit nothing is asked.
    if not joints.size or recording.command is None:
        return
    largest = float(np.max(reached[joints]))
    if not largest > 0.0:
        return
    plain = replace(recording, servo=fill_unknown(servo, goal_acceleration=np.inf))
    held = hold_command(plain)
    rate = hold_command(plain, derivative=1)
    count = 1 + round(np.log(GOAL_FASTEST / GOAL_SLOWEST) / np.log(GOAL_RATIO))
    for limit in (GOAL_SLOWEST * largest * GOAL_RATIO ** np.arange(count)[::-1]).tolist():
        limited = fill_unknown(servo, goal_acceleration=limit)
        if _is_visible(replace(plain, servo=limited), held, rate, joints):
            yield limit


def _is_visible(recording: Recording, held: Array, rate: Array, joints: Indices) -> bool:
    """Whether the goal of a recording differs visibly from the delayed command, in any joint."""
    moved = hold_command(recording) - held
    error = held - recording.q
    rows = find_finite_rows(moved, rate, error)
    if not np.any(rows):
        return False
    moved = moved[rows][:, joints]
    rate = rate[rows][:, joints]
    error = error[rows][:, joints]
    # A limit that only delays is no limit: what is proportional to the rate is taken off.
    late = np.sum(moved * rate, axis=0) / np.maximum(np.sum(rate**2, axis=0), 1e-300)
    size = np.max(np.abs(moved - late * rate), axis=0)
    # The median of the error holds a load; only what varies compares with the goal's change.
    return bool(np.any(size > GOAL_VISIBLE * np.max(np.abs(error - np.median(error, 0)), axis=0)))


def _find_acting_blocks(fall: Array, rows: Equations) -> tuple[TimeBlock, ...]:
    """Return the blocks that make up nine tenths of a fall of the cost (B,)."""
    order = np.argsort(-fall)
    enough = int(np.searchsorted(np.cumsum(fall[order]), 0.9 * np.sum(fall))) + 1
    return tuple(rows.blocks[int(b)] for b in sorted(order[:enough].tolist()))


def _is_significant(fall: Array, rows: Equations, joints: Indices) -> bool:
    """Whether a fall of the cost of blocks (B,) is significant, with one residual per cluster."""
    # Residuals within a cluster are correlated, so that a cluster counts as one.
    share = (
        sum_clusters(fall, rows).size * joints.size / max(float(np.sum(rows.counts[joints])), 1.0)
    )
    return float(np.sum(fall)) * min(share, 1.0) > GOAL_SIGNIFICANCE


def _evaluate_costs(rows: Equations, joints: Indices, usual: Array) -> Array:
    """Return the cost of each block (B,)."""
    return np.asarray(
        sum(
            np.nan_to_num(
                rows.counts[k]
                * np.log1p(block_variances(rows, k, fit_robust_residual(rows, k)) / usual[k])
            )
            for k in joints.tolist()
        )
    )
