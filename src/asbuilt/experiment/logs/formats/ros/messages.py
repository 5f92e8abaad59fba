"""Messages of ROS that hold measured or commanded joints, by their type."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from asbuilt.arrays import Array

JOINT_STATE = "sensor_msgs/msg/JointState"
DYNAMIC_STATE = "control_msgs/msg/DynamicJointState"
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
_NONE = np.empty(0)


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
        Time from that of the message at which they hold [ns], of points of a trajectory.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageKind:
    """Say how messages of a type are read: as measured joints, as commanded ones, or as both."""

    states: Reader | None = None
    commands: Reader | None = None


def _joint_state(logged: int, message: Any) -> list[JointMessage]:
    q, qd, tau = (_array(getattr(message, field)) for field in ("position", "velocity", "effort"))
    return [JointMessage(logged, _stamp(message), tuple(message.name), q, qd, tau)]


def _dynamic_state(logged: int, message: Any) -> list[JointMessage]:
    """Read the interfaces position, velocity and effort of the joints that have a position."""
    found = {
        name: dict(zip(each.interface_names, _array(each.values), strict=False))
        for name, each in zip(message.joint_names, message.interface_values, strict=False)
    }
    joints = tuple(name for name, values in found.items() if "position" in values)
    position, velocity, effort = (
        np.array([found[name][field] for name in joints])
        if all(field in found[name] for name in joints)
        else _NONE
        for field in ("position", "velocity", "effort")
    )
    return [JointMessage(logged, _stamp(message), joints, position, velocity, effort)]


def _measured(logged: int, message: Any) -> list[JointMessage]:
    return _of_controller(logged, message, ("feedback", "actual"))


def _reference(logged: int, message: Any) -> list[JointMessage]:
    return _of_controller(logged, message, ("reference", "desired"))


def _of_controller(logged: int, message: Any, fields: Sequence[str]) -> list[JointMessage]:
    """Read the first of these points of a controller's state that has positions."""
    names = tuple(message.joint_names)
    points = [getattr(message, field) for field in fields if hasattr(message, field)]
    point = next((each for each in points if len(each.positions) == len(names)), None)
    if point is None:
        return []
    q, qd, tau = (_array(each) for each in (point.positions, point.velocities, point.effort))
    return [JointMessage(logged, _stamp(message), names, q, qd, tau)]


def _points(logged: int, message: Any) -> list[JointMessage]:
    names, stamp = tuple(message.joint_names), _stamp(message)
    return [
        JointMessage(
            logged, stamp, names, _array(each.positions), after=_nanoseconds(each.time_from_start)
        )
        for each in message.points
        if len(each.positions) == len(names)
    ]


def _numbers_alone(logged: int, message: Any) -> list[JointMessage]:
    return [JointMessage(logged, 0, (), _array(message.data))]


KINDS: Mapping[str, MessageKind] = MappingProxyType(
    {
        JOINT_STATE: MessageKind(states=_joint_state, commands=_joint_state),
        DYNAMIC_STATE: MessageKind(states=_dynamic_state),
        CONTROLLER_STATE: MessageKind(states=_measured, commands=_reference),
        TRAJECTORY: MessageKind(commands=_points),
        ARRAY: MessageKind(commands=_numbers_alone),
    }
)
"""Types of messages that hold joints."""


def _array(values: Any) -> Array:
    return np.array([np.nan if each is None else float(each) for each in values])


def _stamp(message: Any) -> int:
    return _nanoseconds(message.header.stamp)


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)
