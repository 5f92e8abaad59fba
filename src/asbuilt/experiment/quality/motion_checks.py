"""Checks of the logged motion: units, limits, joints at rest or in step, logged velocities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from asbuilt.description.appearance import stretched_length
from asbuilt.description.model import RobotModel
from asbuilt.experiment.quality.first_pass import FirstPass
from asbuilt.experiment.quality.running_statistics import IN_STEP
from asbuilt.experiment.quality.smoothed_motion import SmoothedMotion
from asbuilt.experiment.quality.velocity_checks import velocity_findings
from asbuilt.findings import Cure, Finding, joined

DEGREE = np.pi / 180
"""A degree in radians."""
MILLIMETRE = 1e-3
"""A millimetre in metres."""


@dataclass(frozen=True, slots=True)
class DegreeThresholds:
    """Decide whether positions are degrees: as radians they are far outside limits, as degrees not.

    `position` and `some` are multiples of the position limits that one joint and a third of the
    joints exceed, `speed` and `median_speed` those of the velocity limits.
    """

    position: float = 2.0
    some: float = 1.2
    as_degrees: float = 1.1
    speed: float = 3.0
    median_speed: float = 1.5
    speed_as_degrees: float = 1.5
    assumed_speed: float = 10.0
    """Velocity limit of a joint without one [rad/s]."""


DEGREES = DegreeThresholds()
_STILL_ANGLE, _STILL_LENGTH = 0.05, 0.005
"""Position range below which a joint hardly moves [rad], and a prismatic one [m]."""


def in_degrees(
    model: RobotModel, recording: FirstPass, motion: SmoothedMotion | None
) -> str | None:
    """Return why the positions must be degrees, None if they need not be."""
    revolute = np.array([joint.is_revolute for joint in model.joints])
    if not revolute.any():
        return None
    extremes = recording.position_range
    largest = np.maximum(np.abs(extremes.low), np.abs(extremes.high))
    largest = np.where(extremes.count > 0, largest, np.nan)[revolute]
    limits = [joint.limits for joint in model.joints if joint.is_revolute]
    bounds = np.array([max(abs(limit.lower), abs(limit.upper)) for limit in limits])
    bounds = np.where(np.isfinite(bounds), bounds, 2 * np.pi)
    over = largest / bounds
    name = np.array(model.joint_names)[revolute]
    if (
        np.max(over) > DEGREES.position
        and np.sum(over > DEGREES.some) >= max(1, revolute.sum() // 3)
        and np.all(over * DEGREE < DEGREES.as_degrees)
    ):
        k = int(np.argmax(over))
        return (
            f"{name[k]} reaches {largest[k]:.4g}, {over[k]:.3g} times its limit of {bounds[k]:.4g}"
            " rad, and as degrees every joint keeps its limits"
        )
    if motion is not None:
        speed = np.percentile(np.abs(motion.qd[:, revolute]), 99.5, axis=0)
        fastest = np.array([limit.velocity for limit in limits])
        known = np.isfinite(fastest) & (fastest > 0)
        ratio = speed / np.where(known, fastest, DEGREES.assumed_speed)
        if (
            np.max(ratio) > DEGREES.speed
            and np.median(ratio) > DEGREES.median_speed
            and np.all(ratio * DEGREE < DEGREES.speed_as_degrees)
        ):
            k = int(np.argmax(ratio))
            return (
                f"{name[k]} turns at {speed[k]:.4g} per second, {ratio[k]:.3g} times its limit of"
                f" {speed[k] / ratio[k]:.4g} rad/s"
            )
    return None


def motion_findings(
    model: RobotModel, recording: FirstPass, motion: SmoothedMotion | None
) -> Iterator[Finding]:
    """Find degrees, positions outside limits, joints at rest or in step, and wrong velocities."""
    degrees = in_degrees(model, recording, motion)
    if degrees is not None:
        yield Finding(
            "degrees",
            "error",
            f"the positions look like degrees: {degrees}",
            Cure('convert them, or write units = { position = "deg" } in a recording sheet'),
        )
    else:
        yield from _in_millimetres(model, recording)
        yield from _limits(model, recording)
    yield from _still(model, recording, DEGREE if degrees is not None else 1.0)
    yield from _correlated(recording)
    if motion is not None and motion.logged_qd is not None:
        yield from velocity_findings(recording, motion, motion.logged_qd)


def _in_millimetres(model: RobotModel, recording: FirstPass) -> Iterator[Finding]:
    """Find sliding joints that are far outside their limits, and inside them as millimetres."""
    for k, joint in enumerate(model.joints):
        bound = max(abs(joint.limits.lower), abs(joint.limits.upper))
        bound = bound if np.isfinite(bound) else stretched_length(model)
        low, high = recording.position_range.low[k], recording.position_range.high[k]
        furthest = float(max(abs(low), abs(high)))
        within = furthest * MILLIMETRE < DEGREES.as_degrees * bound
        if joint.is_revolute or not (furthest > DEGREES.position * bound and within):
            continue
        yield Finding(
            "millimetres",
            "error",
            f"the positions of {joint.name} look like millimetres: it slides to {furthest:.4g},"
            f" {furthest / bound:.3g} times its limit of {bound:.4g} m, and as millimetres it"
            " keeps it",
            Cure(f'write [joint_units] {joint.name} = "mm" in a recording sheet'),
            joint=joint.name,
        )


def _limits(model: RobotModel, recording: FirstPass) -> Iterator[Finding]:
    outside = recording.outside_limits
    for k, joint in enumerate(model.joints):
        count, value, worst = int(outside.count[k]), float(outside.value[k]), int(outside.row[k])
        if not count:
            continue
        unit = "rad" if joint.is_revolute else "m"
        yield Finding(
            "position_limit",
            "warning",
            f"{joint.name} is outside its limits [{joint.limits.lower:.4g},"
            f" {joint.limits.upper:.4g}] {unit} in {count} of {recording.n_samples} samples,"
            f" furthest {value:.4g} {unit} at {recording.t[worst]:.4g} s",
            Cure("compare units and zero position of the joint in the log with the model"),
            joint=joint.name,
            time=float(recording.t[worst]),
        )


def _still(model: RobotModel, recording: FirstPass, scale: float) -> Iterator[Finding]:
    still: list[tuple[str, float, str]] = []
    extremes = recording.position_range
    for k, joint in enumerate(model.joints):
        factor = scale if joint.is_revolute else 1.0
        span = float(extremes.high[k] * factor - extremes.low[k] * factor)
        span = span if extremes.count[k] else 0.0
        if span < (_STILL_ANGLE if joint.is_revolute else _STILL_LENGTH):
            still.append((joint.name, span, "rad" if joint.is_revolute else "m"))
    if len(still) == model.n_joints:
        name, span, unit = max(still, key=lambda joint: joint[1])
        yield Finding(
            "nothing_moves",
            "error",
            f"no joint moves: the largest position range is {span:.3g} {unit}, that of {name}",
            Cure(
                "record the robot in motion, and check that the position columns are the measured"
                " ones",
                call="design_motion",
            ),
        )
        return
    for name, span, unit in still:
        yield Finding(
            "joint_still",
            "warning",
            f"{name} hardly moves: its position range is {span:.3g} {unit}; its friction and part"
            " of its inertia stay undetermined",
            Cure("move every joint over a large part of its range", call="design_motion"),
            joint=name,
        )


def _correlated(recording: FirstPass) -> Iterator[Finding]:
    moving = recording.moments.moving
    if len(moving) < 3:
        return
    correlation = np.abs(recording.moments.correlations(moving))
    group = max((np.flatnonzero(row > IN_STEP) for row in correlation), key=len)
    if len(group) < 3:
        return
    names = [recording.joint_names[moving[k]] for k in group]
    least = float(np.min(correlation[np.ix_(group, group)]))
    everyone = len(group) == recording.n_joints
    yield Finding(
        "joints_correlated",
        "warning" if everyone else "info",
        f"{'all' if everyone else len(group)} joints move in step: {joined(names)} (correlation of"
        f" positions at least {least:.4f}), so their inertias are hard to separate",
        Cure("record a motion in which every joint moves independently", call="design_motion"),
    )
