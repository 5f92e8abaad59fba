"""Whether the logged motion is plausible for the robot.

Units, limits, joints that stand or move alike, velocities that fit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.quality.first_pass import Survey
from asbuilt.experiment.quality.running_statistics import IN_STEP
from asbuilt.experiment.quality.smoothed_motion import SmoothedMotion
from asbuilt.findings import Finding, joined

DEGREE = np.pi / 180
"""A degree in radians."""
_STILL_ANGLE = 0.05
_STILL_LENGTH = 0.005
"""Travel below which a joint hardly moves [rad], and a sliding one [m]."""
_LAG = 0.3
"""Lag of logged velocities, in sampling periods, from which it is told."""
_END = 0.4
"""How long the ends are that a filter may have disturbed [s]."""


def in_degrees(model: RobotModel, recording: Survey, motion: SmoothedMotion | None) -> str | None:
    """Return why the positions must be degrees.

    As radians they leave the limits or exceed the speeds, as degrees they do not.
    """
    turning = np.array([joint.is_revolute for joint in model.joints])
    if not turning.any():
        return None
    furthest = np.where(
        recording.reach.count > 0,
        np.maximum(np.abs(recording.reach.low), np.abs(recording.reach.high)),
        np.nan,
    )
    reach = furthest[turning]
    bounds = np.array([max(abs(j.limits.lower), abs(j.limits.upper)) for j in model.joints])[
        turning
    ]
    bounds = np.where(np.isfinite(bounds), bounds, 2 * np.pi)
    over = reach / bounds
    name = np.array(model.joint_names)[turning]
    if (
        np.max(over) > 2
        and np.sum(over > 1.2) >= max(1, turning.sum() // 3)
        and np.all(over * DEGREE < 1.1)
    ):
        k = int(np.argmax(over))
        return (
            f"{name[k]} reaches {reach[k]:.4g}, {over[k]:.3g} times its limit of {bounds[k]:.4g}"
            " rad, and as degrees every joint keeps its limits"
        )
    if motion is not None:
        speed = np.percentile(np.abs(motion.qd[:, turning]), 99.5, axis=0)
        fastest = np.array([j.limits.velocity for j in model.joints])[turning]
        fastest = np.where(np.isfinite(fastest) & (fastest > 0), fastest, 10.0)
        ratio = speed / fastest
        if np.max(ratio) > 3 and np.median(ratio) > 1.5 and np.all(ratio * DEGREE < 1.5):
            k = int(np.argmax(ratio))
            return (
                f"{name[k]} turns at {speed[k]:.4g} per second, {ratio[k]:.3g} times its limit of"
                f" {fastest[k]:.4g} rad/s"
            )
    return None


def motion_findings(
    model: RobotModel, recording: Survey, motion: SmoothedMotion | None
) -> Iterator[Finding]:
    """Look for degrees, positions outside limits, joints that stand or move alike, and velocities
    that are not the derivative of the positions.
    """
    degrees = in_degrees(model, recording, motion)
    if degrees is not None:
        yield Finding(
            "degrees",
            "error",
            f"the positions look like degrees: {degrees}",
            'Convert them, or write units = { position = "deg" } in a recording sheet beside'
            " the log",
        )
    else:
        yield from _limits(model, recording)
    yield from _still(model, recording, DEGREE if degrees is not None else 1.0)
    yield from _alike(recording)
    if motion is not None and motion.logged_qd is not None:
        yield from _velocities(recording, motion, motion.logged_qd)


def _limits(model: RobotModel, recording: Survey) -> Iterator[Finding]:
    beyond = recording.beyond
    for k, joint in enumerate(model.joints):
        count, value, worst = int(beyond.count[k]), float(beyond.value[k]), int(beyond.row[k])
        if not count:
            continue
        unit = "rad" if joint.is_revolute else "m"
        yield Finding(
            "position_limit",
            "warning",
            f"{joint.name} is outside its limits [{joint.limits.lower:.4g},"
            f" {joint.limits.upper:.4g}] {unit} in {count} of {recording.n_samples} samples,"
            f" furthest {value:.4g} {unit} at {recording.t[worst]:.4g} s",
            "Check the units and the joint's zero position in the log against the model",
            joint=joint.name,
            time=float(recording.t[worst]),
        )


def _still(model: RobotModel, recording: Survey, scale: float) -> Iterator[Finding]:
    standing: list[tuple[str, float, str]] = []
    for k, joint in enumerate(model.joints):
        factor = scale if joint.is_revolute else 1.0
        reach = (
            float(recording.reach.high[k] * factor - recording.reach.low[k] * factor)
            if recording.reach.count[k]
            else 0.0
        )
        if reach < (_STILL_ANGLE if joint.is_revolute else _STILL_LENGTH):
            standing.append((joint.name, reach, "rad" if joint.is_revolute else "m"))
    if len(standing) == model.n_joints:
        name, reach, unit = max(standing, key=lambda joint: joint[1])
        yield Finding(
            "nothing_moves",
            "error",
            f"no joint moves: {name} moves most, {reach:.3g} {unit} in all",
            "Record the robot while it moves (asbuilt excite designs a motion), and check that the"
            " position columns are the measured ones",
        )
        return
    for name, reach, unit in standing:
        yield Finding(
            "joint_still",
            "warning",
            f"{name} hardly moves: {reach:.3g} {unit} in all",
            "Its friction and part of its inertia cannot be found from this recording; move every"
            " joint over a good part of its range",
            joint=name,
        )


def _alike(recording: Survey) -> Iterator[Finding]:
    n = recording.n_joints
    moving = recording.likeness.moving
    if len(moving) < 3:
        return
    likeness = np.abs(recording.likeness.correlations(moving))
    group = max((np.flatnonzero(row > IN_STEP) for row in likeness), key=len)
    if len(group) < 3:
        return
    names = [recording.joint_names[moving[k]] for k in group]
    least = float(np.min(likeness[np.ix_(group, group)]))
    everyone = len(group) == n
    yield Finding(
        "joints_alike",
        "warning" if everyone else "info",
        f"{'all' if everyone else len(group)} joints move in step: {joined(names)} (correlation of"
        f" positions at least {least:.4f})",
        "Their inertias are hard to tell apart; record a motion in which every joint has its own"
        " course (asbuilt excite)",
    )


def _velocities(recording: Survey, motion: SmoothedMotion, logged: Array) -> Iterator[Finding]:
    names = recording.joint_names
    slope = motion.qd
    energy = np.sum(slope**2, axis=0)
    moving = np.flatnonzero((energy > 0) & (np.std(logged, axis=0) > 0))
    if not moving.size:
        if np.all(logged == 0) and np.any(energy > 0):
            yield Finding(
                "velocity_zero",
                "warning",
                f"the logged velocities are 0 in all {recording.n_samples} samples while the joints"
                " move",
                "They are not used; leave the columns out",
            )
        return
    likeness = _correlations(logged[:, moving], slope[:, moving])
    rows, columns = linear_sum_assignment(-likeness)
    swapped = [
        (int(moving[a]), int(moving[b]))
        for a, b in zip(rows, columns, strict=True)
        if a != b and likeness[a, b] > 0.9 and likeness[a, a] < 0.8
    ]
    if swapped:
        told = joined([f"the velocity of {names[a]} is that of {names[b]}" for a, b in swapped])
        yield Finding(
            "velocity_swapped",
            "error",
            f"velocity columns are in another order than position columns: {told}",
            "Name the columns of each joint in a recording sheet: [columns] velocity = [...]",
            joint=names[swapped[0][0]],
        )
        return
    gain = np.sum(logged * slope, axis=0)[moving] / energy[moving]
    middle = float(np.median(gain))
    known = {
        1 / DEGREE: "degrees per second",
        DEGREE: "radians per second while positions are degrees",
    }
    unit = next((text for factor, text in known.items() if abs(middle / factor - 1) < 0.2), None)
    if unit is not None:
        yield Finding(
            "velocity_units",
            "error",
            f"the logged velocities are {middle:.4g} times the derivative of the positions: they"
            f" look like {unit}",
            'Write the unit in a recording sheet: units = { velocity = "deg/s" }',
        )
        return
    for k, factor in zip(moving, gain, strict=True):
        match = float(np.corrcoef(logged[:, k], slope[:, k])[0, 1])
        if match < -0.8:
            message = (
                f"the logged velocity of {names[k]} has the opposite sign of the derivative of its"
                f" position (correlation {match:.3f})"
            )
        elif not 0.7 < factor < 1.4 or match < 0.7:
            message = (
                f"the logged velocity of {names[k]} is {factor:.3g} times the derivative of its"
                " position"
            )
        else:
            continue
        yield Finding(
            "velocity_mismatch",
            "warning",
            message,
            "Leave the velocity columns out, so that positions are differentiated",
            joint=names[k],
        )
    yield from _lag(recording, motion, logged, [int(k) for k in moving])
    yield from _ends(recording, motion, logged, [int(k) for k in moving])


def _lag(
    recording: Survey, motion: SmoothedMotion, logged: Array, moving: list[int]
) -> Iterator[Finding]:
    """Find the shift that matches logged velocities best with the derivative of the positions, to a
    fraction of a sample by a parabola.
    """
    lags = np.array([_best_shift(logged[:, k], motion.qd[:, k]) for k in moving]) / motion.rate
    if not np.all(np.isfinite(lags)):
        return
    fresh = float(np.mean(recording.fresh))
    step = 1.0 / (recording.rate * fresh)
    middle = float(np.median(lags))
    if abs(middle) > _LAG * step:
        low, high = np.sort(np.abs(lags))[[0, -1]]
        worst = moving[int(np.argmax(np.abs(lags)))]
        yield Finding(
            "velocity_lag",
            "info",
            f"the logged velocities {'lag behind' if middle > 0 else 'run ahead of'} the derivative"
            f" of the positions by {1e3 * low:.2g} to {1e3 * high:.2g} ms (samples come every"
            f" {1e3 * step:.3g} ms), most in {recording.joint_names[worst]}",
            "They were filtered or differenced one-sidedly; leave the velocity columns out, so that"
            " positions are differentiated",
            joint=recording.joint_names[worst],
        )


def _best_shift(late: Array, early: Array) -> float:
    """Return by how many samples `late` comes after `early`.

    NaN where no shift up to a fifth of the signal matches.
    """
    most = min(30, late.size // 5)
    if most < 1:
        return float("nan")
    inner = slice(most, late.size - most)
    likeness = np.array(
        [
            np.corrcoef(late[inner], early[most - d : early.size - most - d])[0, 1]
            for d in range(-most, most + 1)
        ]
    )
    k = int(np.argmax(likeness))
    if not 0 < k < likeness.size - 1 or likeness[k] < 0.9:
        return float("nan")
    before, at, after = likeness[k - 1 : k + 2]
    return float(k - most + 0.5 * (before - after) / (before - 2 * at + after))


def _ends(
    recording: Survey, motion: SmoothedMotion, logged: Array, moving: list[int]
) -> Iterator[Finding]:
    """Find ends where velocity and position part, as the transient of a filter makes them."""
    width = int(_END * motion.rate)
    if width < 1 or motion.n_samples < 10 * width:
        return
    apart = np.abs(logged - motion.qd)
    inner = np.sqrt(np.mean(apart[width:-width] ** 2, axis=0))
    spread = np.std(motion.qd, axis=0)
    for name, part in (("first", slice(0, width)), ("last", slice(-width, None))):
        worst = np.max(apart[part], axis=0)
        bad = [k for k in moving if worst[k] > 8 * inner[k] and worst[k] > 0.2 * spread[k]]
        if len(bad) * 2 > len(moving):
            k = max(bad, key=lambda k: worst[k] / spread[k])
            window = "start = 0.5" if name == "first" else f"stop = {recording.duration - 0.5:.4g}"
            yield Finding(
                "end_transient",
                "warning",
                f"in the {name} {_END:g} s logged velocities and positions do not belong together:"
                f" they part by {worst[k]:.3g} rad/s in {recording.joint_names[k]}, against"
                f" {inner[k]:.2g} rad/s elsewhere, as at the end of a filtered signal",
                f"Cut the {name} half second off in a recording sheet: [[windows]] {window}",
                joint=recording.joint_names[k],
                time=float(recording.t[0] if name == "first" else recording.t[-1] - _END),
            )


def _correlations(a: Array, b: Array) -> Array:
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    norms = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0)[None, :]
    likeness: Array = (a.T @ b) / np.where(norms > 0, norms, 1.0)
    return likeness
