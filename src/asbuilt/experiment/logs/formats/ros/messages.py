"""Messages of ROS about joints, a floating base and its contacts, and the choice of topics."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.joint_matching import split_words
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.roles import names_command
from asbuilt.findings import Cure

if TYPE_CHECKING:
    from asbuilt.experiment.logs.sheet import RecordingSheet

JOINT_STATE = "sensor_msgs/msg/JointState"
DYNAMIC_STATE = "control_msgs/msg/DynamicJointState"
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
ESTIMATED_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
IMU = "sensor_msgs/msg/Imu"
WRENCH = "geometry_msgs/msg/WrenchStamped"
FLAG = "std_msgs/msg/Bool"
FIELDS = (("position", "position"), ("velocity", "velocity"), ("effort", "torque"))
"""Fields of a joint state, and their quantities."""
_NONE: Array = np.empty(0)


@dataclass(frozen=True, slots=True, eq=False)
class JointMessage:
    """Hold values of joints at one time.

    Parameters
    ----------
    logged
        When the message was logged [ns].
    stamp
        Time of its header [ns], zero without one.
    names
        The n joints; empty if the message does not name them.
    position, velocity, effort
        Values (n,), empty where the message has none.
    after
        Time after the message at which they hold [ns], of points of a trajectory.

    A state of the base is a position of the names of its columns.
    """

    logged: int
    stamp: int
    names: tuple[str, ...]
    position: Array
    velocity: Array = field(default_factory=lambda: _NONE)
    effort: Array = field(default_factory=lambda: _NONE)
    after: int = 0


Reader = Callable[[int, Any], list[JointMessage]]
"""Reads a message, given when it was logged [ns]."""


def _read_joint_state(logged: int, message: Any) -> list[JointMessage]:
    q, qd, tau = (_make_array(getattr(message, field, ())) for field, _ in FIELDS)
    return [JointMessage(logged, _read_stamp(message), tuple(message.name), q, qd, tau)]


def _read_dynamic_state(logged: int, message: Any) -> list[JointMessage]:
    """Read the interfaces position, velocity and effort of the joints that have a position."""
    found = {
        name: dict(zip(value.interface_names, _make_array(value.values), strict=False))
        for name, value in zip(message.joint_names, message.interface_values, strict=False)
    }
    found = {name: values for name, values in found.items() if "position" in values}
    q, qd, tau = (
        np.array([each[field] for each in found.values() if field in each]) for field, _ in FIELDS
    )
    return [JointMessage(logged, _read_stamp(message), tuple(found), q, qd, tau)]


def _read_controller_state(logged: int, message: Any, fields: Sequence[str]) -> list[JointMessage]:
    """Read the first of these points of a controller's state that has positions."""
    names = tuple(message.joint_names)
    points = [getattr(message, field) for field in fields if hasattr(message, field)]
    point = next((point for point in points if len(point.positions) == len(names)), None)
    if point is None:
        return []
    q, qd, tau = (_make_array(each) for each in (point.positions, point.velocities, point.effort))
    return [JointMessage(logged, _read_stamp(message), names, q, qd, tau)]


def _read_points(logged: int, message: Any) -> list[JointMessage]:
    names = tuple(message.joint_names)
    stamp = _read_stamp(message)
    return [
        JointMessage(
            logged,
            stamp,
            names,
            _make_array(point.positions),
            after=_count_nanoseconds(point.time_from_start),
        )
        for point in message.points
        if len(point.positions) == len(names)
    ]


def _read_base(
    logged: int, message: Any, read: Callable[[Any], dict[str, float]]
) -> list[JointMessage]:
    values = read(message)
    position = np.array([*values.values()])
    return [JointMessage(logged, _read_stamp(message), tuple(values), position)]


def _read_numbers_alone(logged: int, message: Any) -> list[JointMessage]:
    return [JointMessage(logged, 0, (), _make_array(message.data))]


def read_odometry(message: Any) -> dict[str, float]:
    """Return the pose of the base in the world, and its twist in axes of the child frame."""
    twist = message.twist.twist
    speeds = _read_vector("base_v", twist.linear) | _read_vector("base_w", twist.angular)
    return read_pose(message) | speeds


def read_pose(message: Any) -> dict[str, float]:
    """Return the pose of the base in the world, with or without a covariance."""
    pose = getattr(message.pose, "pose", message.pose)
    return _read_vector("base_", pose.position) | _read_vector("base_q", pose.orientation, "xyzw")


def read_imu(message: Any) -> dict[str, float]:
    """Return rates, specific force and orientation; what a sensor does not measure is left out.

    The first element of its covariance is -1 then, or a quaternion is zero.
    """
    parts = {
        "imu_w": (message.angular_velocity, "angular_velocity_covariance", "xyz"),
        "imu_a": (message.linear_acceleration, "linear_acceleration_covariance", "xyz"),
        "imu_q": (message.orientation, "orientation_covariance", "xyzw"),
    }
    found: dict[str, float] = {}
    for start, (vector, covariance, axes) in parts.items():
        values = _read_vector(start, vector, axes)
        measured = [*getattr(message, covariance, ()), 0.0][0] != -1.0
        if measured and (axes == "xyz" or any(values.values())):
            found |= values
    return found


def read_wrench(message: Any) -> dict[str, float]:
    """Return force and moment under the name of the frame in which they are measured."""
    start = f"contact_{message.header.frame_id.rpartition('/')[2]}_"
    parts = message.wrench
    return _read_vector(f"{start}f", parts.force) | _read_vector(f"{start}m", parts.torque)


def read_flag(message: Any) -> dict[str, float]:
    """Return whether a contact is closed; its topic names it (`name_contact`)."""
    return {"contact": float(bool(message.data))}


def name_contact(topic: str) -> str:
    """Return the contact of a topic, "" if its name does not say contact.

    >>> [name_contact(each) for each in ("/contact/FL_foot", "/FL_foot/contact", "/FL_foot/on")]
    ['FL_foot', 'FL_foot', '']
    """
    parts = [re.sub(r"(?i)_?contacts?_?", "", part) for part in topic.split("/")]
    named = [part for part in parts if part]
    return named[-1] if named and "contact" in topic.lower() else ""


def read_frames(message: Any) -> dict[str, str]:
    """Return the frames of what is posed or measured ("base", "imu"), and of the "world"."""
    own = getattr(getattr(message, "header", None), "frame_id", "")
    if hasattr(message, "linear_acceleration"):
        return {"imu": own}
    if hasattr(message, "pose"):
        return {"base": getattr(message, "child_frame_id", ""), "world": own}
    return {}


def _read_vector(start: str, vector: Any, axes: str = "xyz") -> dict[str, float]:
    """Return the components of a vector or quaternion by the names of their columns."""
    found = {f"{start}{axis}": float(getattr(vector, axis)) for axis in axes}
    return {name: value if math.isfinite(value) else math.nan for name, value in found.items()}


KINDS: Mapping[str, dict[str, Reader]] = MappingProxyType(
    {
        JOINT_STATE: {"states": _read_joint_state, "commands": _read_joint_state},
        DYNAMIC_STATE: {"states": _read_dynamic_state},
        CONTROLLER_STATE: {
            "states": partial(_read_controller_state, fields=("feedback", "actual")),
            "commands": partial(_read_controller_state, fields=("reference", "desired")),
        },
        TRAJECTORY: {"commands": _read_points},
        ARRAY: {"commands": _read_numbers_alone},
        ODOMETRY: {"base": partial(_read_base, read=read_odometry)},
        ESTIMATED_POSE: {"base": partial(_read_base, read=read_pose)},
        POSE: {"base": partial(_read_base, read=read_pose)},
        IMU: {"base": partial(_read_base, read=read_imu)},
        WRENCH: {"base": partial(_read_base, read=read_wrench)},
        FLAG: {"base": partial(_read_base, read=read_flag)},
    }
)
"""How messages of a type are read: as measured joints, commanded ones, or a floating base.

The best types come first."""
_BASES = {"base": (ODOMETRY, ESTIMATED_POSE, POSE), "imu": (IMU,)}
SPARSE = 5.0
"""Periods of the states between other messages, or points of a trajectory, beyond which the way
between them matters: a point that is held is late by half its distance."""


def _make_array(values: Any) -> Array:
    return np.array([np.nan if value is None else float(value) for value in values])


def _read_stamp(message: Any) -> int:
    """Return the time of a message [ns], 0 without one."""
    header = getattr(message, "header", message)
    return _count_nanoseconds(getattr(header, "stamp", getattr(header, "timestamp", 0)))


def _count_nanoseconds(time: Any) -> int:
    """Return a time [ns] of seconds and nanoseconds, or of seconds alone as JSON may have them."""
    if isinstance(time, int | float):
        return round(time * 1e9)
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


_NOT_POSITIONS = {
    *("effort", "efforts", "torque", "torques", "current", "force"),
    *("velocity", "velocities", "vel", "speed", "acceleration"),
}
"""Words in the name of a topic whose numbers are no positions."""


@dataclass(frozen=True, slots=True)
class Topics:
    """Hold the topics of states and of commands of a file, None where there is none.

    `types` are the types of all topics, `candidates` all that may hold commands, `base` the topics
    of a floating base. `unread` says why its pose or its sensor has none, and what to do.
    """

    path: Path
    types: Mapping[str, str]
    states: str | None
    commands: str | None
    candidates: tuple[str, ...] = ()
    base: tuple[str, ...] = ()
    unread: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def choose_topics(path: Path, types: Mapping[str, str], sheet: RecordingSheet) -> Topics:
    """Choose among topics, given the type of the messages of each, as far as a sheet does not.

    States are `topic`; else `/joint_states`, the only topic of joint states whose name does not say
    command, desired, target or the like, or the only one of a controller's states. Commands are
    `command_topic`; else the reference of the only controller's state; else the only topic of joint
    states, of trajectories, or of numbers, whose type or name says that it holds commands. The pose
    of a floating base is `base_topic`, or the only odometry, else the only pose; every topic of
    forces, or of flags whose name says contact, may concern a contact.

    Raises
    ------
    RecordingError
        If it is not clear which topic holds the states, or one does not exist.
    """
    of_states = {each for each, kind in types.items() if "states" in KINDS[kind]}
    of_commands = {each for each, kind in types.items() if "commands" in KINDS[kind]}
    of_base = {
        group: {each for each, kind in types.items() if kind in kinds}
        for group, kinds in _BASES.items()
    }
    for topic, known, what in (
        (sheet.topic, of_states, "joint states"),
        (sheet.command_topic, of_commands, "joint states or commands of joints"),
        (sheet.base_topic, of_base["base"], "pose of a base"),
        (sheet.imu_topic, of_base["imu"], "inertial sensor"),
    ):
        if topic is not None and topic not in known:
            raise RecordingError(
                f"{path} has no {what} on topic {topic!r}; it has them on"
                f" {', '.join(sorted(known)) or 'no topic'}",
                file=str(path),
                value=topic,
                available=sorted(known),
            )
    states = sheet.topic or _find_state_topic(path, types, of_states, sheet.command_topic)
    candidates = tuple(
        sorted(
            command for command in of_commands if _holds_commands(command, types[command], states)
        )
    )
    controllers = _list_best(candidates, types, [CONTROLLER_STATE])
    best = controllers if len(controllers) == 1 else candidates
    commands = sheet.command_topic or (best[0] if len(best) == 1 else None)
    base = [
        each
        for each, kind in types.items()
        if kind == WRENCH or (kind == FLAG and name_contact(each))
    ]
    unread: dict[str, tuple[str, str]] = {}
    for group, kinds in _BASES.items():
        measured = {each for each in of_base[group] if not names_command(each)}
        stated = getattr(sheet, f"{group}_topic")
        found = [stated] if stated else _list_best(measured, types, kinds)
        if len(found) > 1:
            unread[group] = (
                f"{path} has messages {types[found[0]]} on {len(found)} topics"
                f" ({', '.join(found)})",
                f'choose one in a recording sheet: {group}_topic = "..."',
            )
        else:
            base += found
    return Topics(path, types, states, commands, candidates, tuple(base), unread)


def _list_best(topics: Iterable[str], types: Mapping[str, str], kinds: Iterable[str]) -> list[str]:
    """Return the topics of the first of these types that any of them has."""
    by_kind = (sorted(topic for topic in topics if types[topic] == kind) for kind in kinds)
    return next((each for each in by_kind if each), [])


def read_times(messages: Sequence[JointMessage], stamped: bool) -> NDArray[np.int64]:
    """Return the times of messages [ns], by the clock of their headers or of the recorder."""
    return np.array(
        [message.stamp if stamped else message.logged for message in messages], dtype=np.int64
    )


def is_stamped(messages: Sequence[JointMessage]) -> bool:
    """Return whether the headers of messages have times, which differ as logging times do."""
    stamps = read_times(messages, stamped=True)
    distinct = len(np.unique(stamps))
    logged = len({message.logged for message in messages})
    unset = int(np.count_nonzero(stamps == 0))
    return unset <= min(1, distinct - 1) and 2 * distinct >= logged


def _find_state_topic(
    path: Path, topics: Mapping[str, str], of_states: set[str], command_topic: str | None
) -> str | None:
    """Return the topic of the states, where none is given."""
    if "/joint_states" in of_states:
        return "/joint_states"
    measured = {
        state
        for state in of_states
        if topics[state] == CONTROLLER_STATE
        or (state != command_topic and not names_command(state))
    }
    best = _list_best(measured or of_states, topics, KINDS)
    if len(best) > 1:
        raise RecordingError(
            f"{path} has joint states on {len(best)} topics ({', '.join(best)})",
            cure=Cure('choose one in a recording sheet: topic = "..."'),
            file=str(path),
            available=best,
        )
    return best[0] if best else None


def _holds_commands(topic: str, kind: str, states: str | None) -> bool:
    """Return whether the type of a topic or its name says that it holds commanded positions."""
    if kind in (CONTROLLER_STATE, TRAJECTORY):
        return True
    if topic == states or not names_command(topic):
        return False
    return kind == JOINT_STATE or (kind == ARRAY and not _NOT_POSITIONS & set(split_words(topic)))
