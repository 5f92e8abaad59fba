"""Recordings with the torque that drove them: as measured, or as a servo makes it of commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.position_servo import PositionServo, read_described_servo
from asbuilt.errors import UsageError
from asbuilt.experiment import Recorded, RecordingStream, Samples, head_of
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.findings import Cure
from asbuilt.identification import IdentificationResult
from asbuilt.validation import Validation


def lacks_torque(item: Recorded) -> bool:
    """Return whether a recording has commands, and gains of their law that are not stated."""
    stated = None if isinstance(item, Samples) else head_of(item).servo
    return stated is not None and not stated.known


def require_torque(item: Recorded) -> None:
    """Raise `UsageError` where a recording has no torque to compare with."""
    if lacks_torque(item):
        raise UsageError(
            f"{item.source} holds commands and no gains of the servo, so that it has"
            " no torque to compare with",
            cure=Cure("compare simulated motion", {"rollout": "0.5"}),
        )


def drive_as_built(result: IdentificationResult, item: Recorded) -> Recorded:
    """Return a recording whose torque follows its command as a result has it."""
    return with_servo(item, result.servo)


def with_servo(item: Recorded, servo: PositionServo | None) -> Recorded:
    """Return a recording with the torque of a servo that follows its command, if it has one.

    A limit of the goal that is stated for the recording holds there.
    """
    if servo is None or isinstance(item, Samples):
        return item
    stated = head_of(item).servo
    if stated is not None:
        stated_limit = np.array(stated.goal_acceleration)
        # A limit that is stated for a recording holds in it.
        kept = np.where(np.isnan(stated_limit), servo.goal_acceleration, stated_limit)
        servo = replace(servo, goal_acceleration=tuple(kept.tolist()), goal_speed=stated.goal_speed)
    if isinstance(item, RecordingStream):
        return replace(item, change=partial(drive_by_command, servo=servo))
    return drive_by_command(item, servo) if item.command is not None else item


def drive_as_described(model: RobotModel, item: Recorded) -> Recorded:
    """Return a recording whose servo has the gains of the description where it states none.

    Raises `UsageError` if neither states them, for a robot as described then has no torque.
    """
    if isinstance(item, Samples) or not lacks_torque(item):
        return item
    stated = head_of(item).servo
    described = read_described_servo(model)
    servo = stated.completed(described) if stated and described else stated
    if servo is None or not servo.known:
        raise UsageError(
            f"{head_of(item).source}: the stiffness or damping of a servo is stated neither for"
            f" the recording nor by {model.name}, and without both a robot as described has no"
            " torque",
            cure=Cure("state both, or identify them", {"kp": "LIST", "kd": "LIST"}),
        )
    return with_servo(item, servo)


def find_asked_torques(
    result: IdentificationResult, recordings: Sequence[Recorded], training: Sequence[Validation]
) -> tuple[Array | None, Sequence[Validation]]:
    """Return the largest torques (n,) that commands asked for, and motions that show limits.

    None, and no motion, where torques were measured; limits that are stated need not be shown.
    """
    if result.servo is None:
        return None, ()
    limited = np.any(np.isfinite(result.servo.torque_limit))
    return _find_peaks(recordings, result.servo), () if limited else training


def _find_peaks(recordings: Sequence[Recorded], servo: PositionServo) -> Array:
    """Return the largest torque (n,) that the servo of each joint was asked for."""
    # Without its limits, so that what was asked for shows.
    free = replace(servo, torque_limit=())
    heads = [head_of(item) for item in recordings if not isinstance(item, Samples)]
    asked = [drive_by_command(head, free).tau for head in heads if head.command is not None]
    return np.asarray(np.max([np.abs(tau).max(axis=0) for tau in asked], axis=0))
