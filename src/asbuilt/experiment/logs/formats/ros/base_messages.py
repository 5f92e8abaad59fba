"""Messages of ROS about a floating base: odometry, poses, inertial sensors, forces of contacts."""

from __future__ import annotations

import math
import re
from typing import Any

ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
ESTIMATED_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
IMU = "sensor_msgs/msg/Imu"
WRENCH = "geometry_msgs/msg/WrenchStamped"
FLAG = "std_msgs/msg/Bool"


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
