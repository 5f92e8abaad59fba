"""Deadband of a position servo, sought in recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.recording import Recording
from asbuilt.identification.servo.servo_rows import CommandedMotion, ServoRows, servo_rows
from asbuilt.identification.servo.servo_scale import block_weights, clustered, truncated_solution


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
    passes
        Passes of the robust weights of time blocks.
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
    passes: int = 4
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


def recorded_deadband(
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
        return servo_rows(motions, driven, late, rates)

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
    usual = _usual(plain, joints)
    kept: dict[float, Array] = {}

    def costs(width: float) -> Array:
        if width not in kept:
            kept[width] = _costs(rows(width), plain, joints, usual)
        return kept[width]

    best, lowest = 0.0, float(np.sum(costs(0.0)))
    for width in _widths(plain, joints):
        cost = float(np.sum(costs(width)))
        if not cost < lowest:
            break
        best, lowest = width, cost
    if best == 0.0 or not _better(costs(0.0) - costs(best), plain):
        return None
    found = minimize_scalar(
        lambda x: float(np.sum(costs(float(np.exp(x))))),
        bounds=np.log(best) + np.log(RULES.ratio) * np.array([-1.0, 1.0]),
        method="bounded",
        options={"xatol": 2e-3},
    )
    width = float(np.exp(found.x))
    error = _relative_error(costs, width, plain)
    if not error < RULES.determined or not _better(costs(0.0) - costs(width), plain):
        return None
    return Deadband(width, width * float(np.hypot(error, RULES.accuracy)))


def _widths(plain: ServoRows, joints: Indices) -> Iterator[float]:
    """Yield the widths to try, smallest first."""
    sizes = [np.sqrt(plain.total(k)[-1, -1] / max(plain.counts[k].sum(), 1)) for k in joints]
    width = RULES.smallest * float(np.median(sizes))
    while width < RULES.largest * float(np.median(sizes)):
        yield width
        width *= RULES.ratio


def _costs(rows: ServoRows, plain: ServoRows, joints: Indices, usual: Array) -> Array:
    """Return the cost of each joint and block (n joints, B), fitted to the other half."""
    second = (np.arange(len(rows.times)) // RULES.half) % 2 == 1
    found = np.zeros((joints.size, len(rows.times)))
    for row, k in enumerate(joints.tolist()):
        shrunk = max(rows.total(k)[-1, -1] / plain.total(k)[-1, -1], 1e-300)
        for here in (second, ~second):
            left = rows.variances(k, _residual(rows, k, ~here)) / shrunk
            cost = np.nan_to_num(rows.counts[k] * np.log1p(left / usual[row]))
            found[row, here] = cost[here]
    return found


def _usual(plain: ServoRows, joints: Indices) -> Array:
    """Return the median mean square of the residuals of each joint over blocks (n joints,)."""
    usual = np.ones(joints.size)
    everywhere = np.ones(len(plain.times), dtype=np.bool_)
    for row, k in enumerate(joints.tolist()):
        variances = plain.variances(k, _residual(plain, k, everywhere))
        if np.any(np.isfinite(variances)):
            usual[row] = max(float(np.nanmedian(variances)), 1e-300)
    return usual


def _residual(rows: ServoRows, k: int, used: Mask) -> Array:
    """Return the residual of a joint's fit to some blocks, as a combination of its rows."""
    weight = used.astype(np.float64)
    for _ in range(RULES.passes):
        gram = rows.total(k, weight)
        x = truncated_solution(gram[:-1, :-1], gram[:-1, -1])
        weight = used * block_weights(rows, k, np.append(-x, 1.0))
    return np.append(-x, 1.0)


def _better(fall: Array, rows: ServoRows) -> bool:
    """Whether costs (n joints, B) fall significantly in all, and rise at no joint."""
    each = np.array([_sigmas(clustered(own, rows)) for own in fall])
    return _sigmas(clustered(fall.sum(axis=0), rows)) > RULES.sigmas and bool(
        np.all(each > -RULES.worse)
    )


def _sigmas(parts: Array) -> float:
    """Return the sum of independent parts in its standard errors."""
    spread = float(np.sqrt(np.sum((parts - parts.mean()) ** 2) * parts.size / (parts.size - 1)))
    return float(parts.sum()) / max(spread, 1e-300) if parts.size > 1 else 0.0


def _relative_error(costs: Callable[[float], Array], width: float, rows: ServoRows) -> float:
    """Return the standard error of the logarithm of the width, from the scores of the blocks."""
    step = 0.05
    up, down = (costs(float(width * np.exp(s * step))).sum(axis=0) for s in (1.0, -1.0))
    scores = clustered((up - down) / (2.0 * step), rows)
    curvature = float(np.sum(up + down - 2.0 * costs(width).sum(axis=0))) / step**2
    return float(np.sqrt(np.sum(scores**2)) / curvature) if curvature > 0.0 else float("inf")
