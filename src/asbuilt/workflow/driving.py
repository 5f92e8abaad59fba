"""Recordings with the torque that drove them: as measured, or as a servo makes it of commands.

The room of servos, `workflow/servo`, is entered here, and only if some torque follows a command.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.experiment import Recorded, Samples, head_of
from asbuilt.findings import Cure
from asbuilt.identification import IdentificationResult
from asbuilt.validation import Validation
from asbuilt.workflow.study_options import StudyOptions
from asbuilt.workflow.torque_source import MeasuredTorque

if TYPE_CHECKING:
    from asbuilt.experiment.signal.prepared_motion import MotionFilters


def settle_torque(
    model: RobotModel,
    recordings: Sequence[Recorded],
    validation: Sequence[Recorded],
    options: StudyOptions,
    filters: MotionFilters | None = None,
) -> tuple[list[Recorded], list[Recorded], MeasuredTorque, StudyOptions]:
    """Return recordings with their torque, where it comes from, and the options.

    Nothing changes unless some torque is to follow from a command. `filters` filter motions, if
    some serve others too. Raises `UsageError` where recordings have torques of different kinds.
    """
    if not any(map(_has_command, (*recordings, *validation))):
        return [*recordings], [*validation], MeasuredTorque(), options
    from asbuilt.workflow.servo import settle_servo  # noqa: PLC0415 - light start

    return settle_servo(model, recordings, validation, options, filters)


def _has_command(item: Recorded) -> bool:
    return not isinstance(item, Samples) and head_of(item).drive_law is not None


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
    if result.servo is None:
        return item
    from asbuilt.workflow.servo import with_servo  # noqa: PLC0415 - light start

    return with_servo(item, result.servo)


def drive_as_described(model: RobotModel, item: Recorded) -> Recorded:
    """Return a recording with gains of the description where it states none.

    Raises `UsageError` if neither states them, for a robot as described then has no torque.
    """
    if not lacks_torque(item):
        return item
    from asbuilt.workflow.servo import with_described_servo  # noqa: PLC0415 - light start

    return with_described_servo(model, item)


def find_asked_torques(
    result: IdentificationResult, recordings: Sequence[Recorded], training: Sequence[Validation]
) -> tuple[Array | None, Sequence[Validation]]:
    """Return the largest torques (n,) that commands asked for, and motions that show limits.

    None, and no motion, where torques were measured; limits that are stated need not be shown.
    """
    if result.servo is None:
        return None, ()
    from asbuilt.workflow.servo import find_asked_peaks  # noqa: PLC0415 - light start

    limited = any(limit < float("inf") for limit in result.servo.torque_limit)
    return find_asked_peaks(recordings, result.servo), () if limited else training
