"""Calibration of torques: gains from a known payload, sensors beside motors."""

from __future__ import annotations

from collections.abc import Sequence

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.experiment.logs.long_recordings import head_of
from asbuilt.experiment.logs.recordings import RecordingLike, fitted_recordings
from asbuilt.experiment.quality.checks import TOO_LITTLE, UNKNOWN_TORQUE
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.calibration.torque_gains import (
    TorqueGains,
    gains_in_use,
    identify_gains,
)
from asbuilt.identification.calibration.two_channels import (
    LINK_SIDE,
    TwoChannelEstimate,
    identify_two_channels,
)
from asbuilt.workflow.options import ChannelOptions, GainOptions
from asbuilt.workflow.prepare import Progress, prepare


def find_gains(
    robot: RobotModel | str,
    recordings: RecordingLike | Sequence[RecordingLike],
    loaded: RecordingLike | Sequence[RecordingLike],
    *,
    mass: float,
    options: GainOptions | None = None,
    progress: Progress | None = None,
) -> TorqueGains:
    """Identify the torque per logged unit of every drive from a payload of known mass.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    recordings, loaded
        Recordings of the bare arm and with the payload, one or several each, as for `identify`.
    mass
        Mass of the payload [kg].
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    TorqueGains
        The gains with standard errors, in place of those that the recordings were read with.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording other than wrong gains.
    IdentifiabilityError
        If the recordings do not determine the gains.
    """
    options = options or GainOptions()
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    model, (bare, under) = fitted_recordings(model, (recordings, loaded))
    prepared = prepare(
        model,
        [*bare, *under],
        chain=options.chain,
        checked=options.checked,
        tolerated=(*TOO_LITTLE, *UNKNOWN_TORQUE),
        progress=progress,
    )
    heads = [head_of(item) for item in (*bare, *under) if not isinstance(item, Samples)]
    return identify_gains(
        model,
        prepared.training[: len(bare)],
        prepared.training[len(bare) :],
        mass=mass,
        com=options.com,
        drive=options.drive,
        frame=options.frame,
        in_use=gains_in_use(heads),
    )


def identify_channels(
    robot: RobotModel | str,
    sensor: RecordingLike | Sequence[RecordingLike],
    motor: RecordingLike | Sequence[RecordingLike],
    *,
    options: ChannelOptions | None = None,
    progress: Progress | None = None,
) -> TwoChannelEstimate:
    """Identify links, link-side friction and motor side from torques on both sides of the gears.

    Parameters
    ----------
    robot
        A robot, the name of a bundled one, or the path of a description.
    sensor, motor
        Recordings of the joint torque sensors and of the motor torques, one or several, in the
        same order, as for `identify`.
    options
        How to identify; None: the defaults.
    progress
        Called with the name of a step and the fraction done.

    Returns
    -------
    TwoChannelEstimate
        The parameters of both sides with standard errors.

    Raises
    ------
    RecordingError
        If a check finds an error in a recording.
    UsageError
        If the two channels were not logged at the same instants.
    """
    options = options or ChannelOptions()
    model = robot if isinstance(robot, RobotModel) else load_robot(robot)
    model, (sensors, motors) = fitted_recordings(model, (sensor, motor))
    if len(sensors) != len(motors):
        raise UsageError(
            f"each recording needs both channels, got {len(sensors)} of sensors and {len(motors)}"
            " of motors"
        )
    prepared = prepare(
        model,
        sensors,
        others=(motors,),
        chain=options.chain,
        checked=options.checked,
        progress=progress,
    )
    return identify_two_channels(
        model,
        prepared.training,
        prepared.others[0],
        link_side=options.link_side or LINK_SIDE,
        motor_side=options.motor_side,
    )
