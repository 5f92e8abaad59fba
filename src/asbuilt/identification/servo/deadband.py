"""Deadband of a position servo, sought in recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.recording import Recording
from asbuilt.identification.servo.block_fits import (
    fit_robust_residual,
    logarithmic_error,
    refine_minimum,
    sum_clusters,
    usual_variances,
)
from asbuilt.identification.servo.servo_rows import (
    CommandedMotion,
    ServoRows,
    reduce_servo_recordings,
)


@dataclass(frozen=True, slots=True)
class DeadbandRules:
    """Say how a deadband is sought, and when it counts as found: own choices.

    Parameters
    ----------
    smallest, largest, ratio
        Range of the width, in units of the root mean square of the control error of a typical
        joint, and ratio of neighbouring widths that are tried.
    sigmas
        Standard errors by which the cost of all joints must fall.
    worse
        Standard errors by which the cost of no joint may rise.
    determined
        Largest relative standard error of the width.
    accuracy
        Relative error by the filters, beside that by noise: virtual arms differ by up to 0.6 %.
    half
        Blocks together that are fitted or validated.
    """

    smallest: float = 0.02
    largest: float = 0.7
    ratio: float = 2.0
    sigmas: float = 3.0
    worse: float = 2.0
    determined: float = 0.2
    accuracy: float = 0.01
    half: int = 5


RULES = DeadbandRules()


@dataclass(frozen=True, slots=True)
class Deadband:
    """Hold a deadband [rad or m] with its standard error."""

    width: float
    std_error: float


def with_deadband(servo: PositionServo, width: float) -> PositionServo:
    """Return the servo with a deadband where it was unknown."""
    given = np.array(servo.deadband)
    return replace(servo, deadband=tuple(np.where(np.isnan(given), width, given).tolist()))


def estimate_deadband(
    motions: Sequence[CommandedMotion], recordings: Sequence[Recording], late: float
) -> Deadband | None:
    """Return the deadband that the recordings show; None if it is known, or they show none.

    `motions` are those of the recordings, whose command acts after `late` [s].
    """
    servo = recordings[0].servo
    unknown = np.isnan(np.array(() if servo is None else servo.deadband))
    if not np.any(unknown):
        return None
    rates = [motion.rate(each, late) for motion, each in zip(motions, recordings, strict=True)]

    def rows(width: float) -> ServoRows:
        driven = [
            replace(each, servo=with_deadband(each.servo, width))
            for each in recordings
            if each.servo is not None
        ]
        return reduce_servo_recordings(motions, driven, late, rates)

    return find_deadband(rows, unknown)


def find_deadband(rows: Callable[[float], ServoRows], unknown: Mask) -> Deadband | None:
    """Return the deadband under which recordings are predicted best; None if they show none.

    For each width `D(e) = W b + v qd + step du/dt` is fitted joint by joint to half of the time
    blocks, with everything free, and validated on the others, both ways. The residual counts
    relative to D(e), whose scale is that of the torque. Joints share the width: it counts only if
    the cost falls, and significantly rises at no joint, as friction that grows with the load, which
    resembles a deadband, would have it.

    Parameters
    ----------
    rows
        Returns the rows of all recordings under a width.
    unknown
        Joints (n,) whose deadband is unknown.
    """
    joints = np.flatnonzero(unknown)
    plain = rows(0.0)
    usual = usual_variances(plain, joints)
    kept: dict[float, Array] = {}

    def costs(width: float) -> Array:
        if width not in kept:
            kept[width] = _evaluate_costs(rows(width), plain, joints, usual)
        return kept[width]

    best, lowest = 0.0, float(np.sum(costs(0.0)))
    for width in _list_widths(plain, joints):
        cost = float(np.sum(costs(width)))
        if not cost < lowest:
            break
        best, lowest = width, cost
    if best == 0.0 or not _is_better(costs(0.0) - costs(best), plain):
        return None
    width = refine_minimum(costs, best, RULES.ratio, 2e-3)
    error = logarithmic_error(costs, width, plain)
    if not error < RULES.determined or not _is_better(costs(0.0) - costs(width), plain):
        return None
    return Deadband(width, width * float(np.hypot(error, RULES.accuracy)))


def _list_widths(plain: ServoRows, joints: Indices) -> Iterator[float]:
    """Yield the widths to try, smallest first."""
    sizes = [np.sqrt(plain.total(k)[-1, -1] / max(plain.counts[k].sum(), 1)) for k in joints]
    width = RULES.smallest * float(np.median(sizes))
    while width < RULES.largest * float(np.median(sizes)):
        yield width
        width *= RULES.ratio


def _evaluate_costs(rows: ServoRows, plain: ServoRows, joints: Indices, usual: Array) -> Array:
    """Return the cost of each joint and block (n joints, B), fitted to the other half."""
    second = (np.arange(len(rows.times)) // RULES.half) % 2 == 1
    found = np.zeros((joints.size, len(rows.times)))
    for row, k in enumerate(joints.tolist()):
        shrunk = max(rows.total(k)[-1, -1] / plain.total(k)[-1, -1], 1e-300)
        for here in (second, ~second):
            left = rows.variances(k, fit_robust_residual(rows, k, ~here)) / shrunk
            cost = np.nan_to_num(rows.counts[k] * np.log1p(left / usual[k]))
            found[row, here] = cost[here]
    return found


def _is_better(fall: Array, rows: ServoRows) -> bool:
    """Whether costs (n joints, B) fall significantly in all, and rise at no joint."""
    each = np.array([_count_sigmas(sum_clusters(own, rows)) for own in fall])
    return _count_sigmas(sum_clusters(fall.sum(axis=0), rows)) > RULES.sigmas and bool(
        np.all(each > -RULES.worse)
    )


def _count_sigmas(parts: Array) -> float:
    """Return the sum of independent parts in its standard errors."""
    if parts.size < 2:
        return 0.0
    spread = float(np.sqrt(np.sum((parts - parts.mean()) ** 2) * parts.size / (parts.size - 1)))
    return float(parts.sum()) / max(spread, 1e-300)
