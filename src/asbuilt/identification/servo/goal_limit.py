"""Limit of the acceleration that a position servo gives its goal, sought in a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain as chain_of

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.command.servo_torque import hold_command
from asbuilt.experiment.recording import Recording
from asbuilt.identification.information.rows import TimeBlock
from asbuilt.identification.servo.block_fits import (
    fit_robust_residual,
    logarithmic_error,
    refine_minimum,
    sum_clusters,
    usual_variances,
)
from asbuilt.identification.servo.servo_rows import ServoRows


@dataclass(frozen=True, slots=True)
class GoalRules:
    """Say how a limit is sought, and when it counts as found: own choices.

    Parameters
    ----------
    slowest, fastest
        Range of the limit, in units of the largest acceleration that joints reached; a joint that
        resonates reaches more than its goal.
    ratio
        Ratio of neighbouring limits that are tried.
    visible
        Largest change of the goal beyond a delay, in units of the control error, below which a
        limit is not distinguishable from none.
    significance
        Smallest likelihood ratio statistic, residuals taken as one per cluster of blocks: three
        standard errors.
    determined
        Largest relative standard error.
    """

    slowest: float = 0.15
    fastest: float = 8.0
    ratio: float = 1.5
    visible: float = 0.15
    significance: float = 9.0
    determined: float = 0.2


RULES = GoalRules()


@dataclass(frozen=True, slots=True, eq=False)
class GoalLimit:
    """Hold a limit of the goal's acceleration [rad/s^2 or m/s^2] with its standard error.

    `acts` are the time blocks that it explains, in order of time.
    """

    acceleration: float
    std_error: float
    acts: tuple[TimeBlock, ...]


def limit_goal(servo: PositionServo, acceleration: float) -> PositionServo:
    """Return the servo with a limit of the goal's acceleration where it was unknown."""
    given = np.array(servo.goal_acceleration)
    values = np.where(np.isnan(given), acceleration, given)
    return replace(servo, goal_acceleration=tuple(values.tolist()))


def average_limits(goals: Sequence[GoalLimit | None]) -> tuple[float, float]:
    """Return the weighted mean of limits and its standard error.

    Infinite and 0 if a recording shows none.
    """
    found = [goal for goal in goals if goal is not None]
    if not found or len(found) < len(goals):
        return np.inf, 0.0
    weight = np.array([1.0 / goal.std_error**2 for goal in found])
    mean = float(np.average([goal.acceleration for goal in found], weights=weight))
    return mean, float(np.sum(weight) ** -0.5)


def find_goal_limit(
    recording: Recording,
    servo: PositionServo,
    reached: Array,
    rows: Callable[[PositionServo], ServoRows],
) -> GoalLimit | None:
    """Return the limit under which a recording fits best; None if it shows none.

    For each limit `goal - q = W b + v qd + step dgoal/dt` is fitted joint by joint, with everything
    free. The cost is that of residuals whose variance varies from block to block, with a bounded
    influence of each (`n log(1 + r / median)` for the mean square r of n rows), so that contact
    does not count.

    Parameters
    ----------
    recording
        The recording.
    servo
        Its servo; a limit that is NaN is sought, one for all such joints.
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
    plain = rows(limit_goal(servo, np.inf))
    usual = usual_variances(plain, joints)
    without = _evaluate_costs(plain, joints, usual)
    kept: dict[float, Array] = {}

    def costs(limit: float) -> Array:
        if limit not in kept:
            kept[limit] = _evaluate_costs(rows(limit_goal(servo, limit)), joints, usual)
        return kept[limit]

    tried: list[float] = []
    sums: list[float] = []
    for limit in chain_of([first], visible):
        tried.append(limit)
        sums.append(float(np.sum(costs(limit) - without)))
        if len(sums) > 1 and min(sums[-2:]) > 0.0:
            break
    best = tried[int(np.argmin(sums))]
    if not _is_better(without - costs(best), plain, joints):
        return None
    limit = refine_minimum(costs, best, RULES.ratio, 5e-3)
    error = logarithmic_error(costs, limit, plain)
    if not error < RULES.determined:
        return None
    return GoalLimit(
        limit,
        limit * error,
        _find_acting_blocks(without - costs(limit), plain),
    )


def _list_visible_limits(
    recording: Recording, servo: PositionServo, reached: Array, joints: Indices
) -> Iterator[float]:
    """Yield the limits in their range that change the goal beyond a delay, fastest first."""
    if not joints.size or recording.command is None:
        return
    largest = float(np.max(reached[joints]))
    if not largest > 0.0:
        return
    plain = replace(recording, servo=limit_goal(servo, np.inf))
    held, rate = hold_command(plain), hold_command(plain, derivative=1)
    count = 1 + round(np.log(RULES.fastest / RULES.slowest) / np.log(RULES.ratio))
    for limit in (RULES.slowest * largest * RULES.ratio ** np.arange(count)[::-1]).tolist():
        if _is_visible(replace(plain, servo=limit_goal(servo, limit)), held, rate, joints):
            yield limit


def _is_visible(recording: Recording, held: Array, rate: Array, joints: Indices) -> bool:
    """Whether the goal of a recording differs visibly from the delayed command, in any joint."""
    moved, error = hold_command(recording) - held, held - recording.q
    rows = np.all(np.isfinite(moved) & np.isfinite(rate) & np.isfinite(error), axis=1)
    if not np.any(rows):
        return False
    moved, rate, error = moved[rows][:, joints], rate[rows][:, joints], error[rows][:, joints]
    late = np.sum(moved * rate, axis=0) / np.maximum(np.sum(rate**2, axis=0), 1e-300)
    size = np.max(np.abs(moved - late * rate), axis=0)
    return bool(np.any(size > RULES.visible * np.max(np.abs(error - np.median(error, 0)), axis=0)))


def _find_acting_blocks(fall: Array, rows: ServoRows) -> tuple[TimeBlock, ...]:
    """Return the blocks that make up nine tenths of a fall of the cost (B,)."""
    order = np.argsort(-fall)
    enough = int(np.searchsorted(np.cumsum(fall[order]), 0.9 * np.sum(fall))) + 1
    return tuple(rows.times[int(b)] for b in sorted(order[:enough].tolist()))


def _is_better(fall: Array, rows: ServoRows, joints: Indices) -> bool:
    """Whether a fall of the cost of blocks (B,) is significant, with one residual per cluster."""
    share = (
        sum_clusters(fall, rows).size * joints.size / max(float(np.sum(rows.counts[joints])), 1.0)
    )
    return float(np.sum(fall)) * min(share, 1.0) > RULES.significance


def _evaluate_costs(rows: ServoRows, joints: Indices, usual: Array) -> Array:
    """Return the cost of each block (B,)."""
    return np.asarray(
        sum(
            np.nan_to_num(
                rows.counts[k]
                * np.log1p(rows.variances(k, fit_robust_residual(rows, k)) / usual[k])
            )
            for k in joints.tolist()
        )
    )
