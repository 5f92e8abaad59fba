"""What the torque of recordings is: measured, or what a position servo makes of commands.

Whoever has a study, a rollout or a review asks here; `workflow/servo` identifies the servo.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.position_servo import PositionServo, read_described_servo
from asbuilt.errors import UsageError
from asbuilt.experiment import Recorded, RecordingStream, Samples, head_of
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.findings import Cure, Finding
from asbuilt.identification import IdentificationResult
from asbuilt.identification.identify import Fit
from asbuilt.validation import Validation
from asbuilt.workflow.prepare import Prepared

if TYPE_CHECKING:
    from asbuilt.identification.trajectories.refined_fit import RefinedFit
    from asbuilt.identification.trajectories.simulated_robot import ServoCoordinates
    from asbuilt.identification.uncertainty.pose_noise import MeanScores


class TorqueOrigin:
    """Say where the torques of a study come from, and what of that is to be identified.

    A study asks by these methods. Here torques were measured, by a sensor or as the current of a
    motor, and nothing is to be identified; another origin overrides its part.
    """

    @property
    def expected(self) -> MeanScores | None:
        """Scores that its noise lends the parameters."""
        return None

    @property
    def law(self) -> PositionServo | None:
        """What makes torques of commands, and moves a simulated robot with them."""
        return None

    @property
    def free(self) -> ServoCoordinates | None:
        """What of the law is unknown, so that trajectories are fitted to it."""
        return None

    @property
    def is_measured(self) -> bool:
        """Whether delays, effects and errors of single recordings are those of a sensor."""
        return True

    @property
    def decisive_horizons(self) -> tuple[float, ...]:
        """Windows [s] of simulated motion without which there is no verdict."""
        return ()

    @property
    def of_result(self) -> dict[str, Any]:
        """What it adds to a result, by field."""
        return {}

    def settle_samples(self, prepared: Prepared, recordings: Sequence[Recorded]) -> Prepared:
        """Return the samples of recordings as it accounts for them."""
        return prepared

    def with_delays(self, prepared: Prepared, recordings: Sequence[tuple[str, str]]) -> Prepared:
        """Return samples with its delay, where it has one, by name and digest of recordings."""
        return prepared

    def refined(self, refined: RefinedFit) -> TorqueOrigin:
        """Return it as trajectories show it."""
        return self

    def with_errors(self, fit: Fit) -> Fit:
        """Return a fit whose errors include its own."""
        return fit

    def sentences(self, model: RobotModel) -> tuple[str, ...]:
        """Return what the torques rest on."""
        return ()

    def findings(self, model: RobotModel, drive: DriveSet) -> Iterable[Finding]:
        """Return what is worth knowing of it."""
        return ()


def lacks_torque(item: Recorded) -> bool:
    """Return whether a recording has commands, and gains of their law that are not stated."""
    stated = None if isinstance(item, Samples) else head_of(item).servo
    return stated is not None and not stated.known


def require_torque(item: Recorded) -> None:
    """Raise `UsageError` where a recording has no torque to compare with.

    Gains that only the description states are no help: they are part of what is compared, and often
    settings of a simulator. A rollout tests them with the rest.
    """
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
