"""LeRobot's calibration of servos, next to a dataset: what its numbers are in radians.

LeRobot logs the counts of an encoder either as degrees from the middle of the calibrated range, or
as -100 to 100 of that range, and grippers as 0 (closed) to 100 (open). Which one, a dataset does
not say; the calibration and the largest numbers together often do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.joint_matching import names_gripper
from asbuilt.errors import RecordingError
from asbuilt.findings import Cure
from asbuilt.untrusted import parse_json

COUNTS = 4096
"""Counts of a turn of the encoders of Feetech STS and Dynamixel X servos."""

LARGEST_FILE = 100_000
"""Bytes; a calibration has a hundred a joint, other JSON files of a folder may have megabytes."""

SHARE_TOLERANCE = 0.1
"""Of numbers from -100 to 100, which LeRobot clips: rounding alone exceeds 100."""

DEGREE_MARGIN = 1.1
"""Times half the range: degrees are not clipped, and servos yield a little beyond the range."""


@dataclass(frozen=True)
class ServoCalibration:
    """Hold the calibrated ranges of servos.

    Parameters
    ----------
    file
        Where they are from.
    half_ranges
        Half the calibrated range [rad] of each joint.
    inverted
        Joints whose numbers from -100 to 100 have the opposite sign (`drive_mode` 1).
    """

    file: Path
    half_ranges: Mapping[str, float]
    inverted: frozenset[str]

    def find_unit(self, joints: Sequence[str], values: Array) -> str:
        """Return the unit of positions (N, n): "deg", "percent" of the range, or "" if open."""
        for joint, column in zip(joints, values.T, strict=True):
            if names_gripper(joint) or not np.isfinite(column).any():
                continue
            largest = float(np.nanmax(np.abs(column)))
            if largest > 100.0 + SHARE_TOLERANCE:
                return "deg"
            if largest > DEGREE_MARGIN * np.rad2deg(self.half_ranges[joint]):
                return "percent"
        return ""

    def find_range(self, joint: str, unit: str) -> list[float]:
        """Return two numbers of the log and the positions [rad] there."""
        half = self.half_ranges[joint]
        if names_gripper(joint):
            return [0.0, 100.0, 0.0, 2.0 * half]
        if unit == "deg":
            return [-180.0, 180.0, -pi, pi]
        sign = -1.0 if joint in self.inverted else 1.0
        return [-100.0, 100.0, -sign * half, sign * half]


def find_calibration(dataset: Path, joints: Sequence[str]) -> ServoCalibration | None:
    """Return the calibration of these joints in a dataset or next to it, None without one.

    Of several in one folder, as of a leader and a follower, the follower's is taken.

    Raises
    ------
    RecordingError
        If a range has no extent, or several files are equally good.
    """
    for folder in (dataset, dataset / "meta", dataset.parent):
        found = [each for file in sorted(folder.glob("*.json")) if (each := _read(file, joints))]
        if len(found) > 1:
            found = [each for each in found if "follower" in each.file.stem] or found
        if len(found) > 1:
            names = ", ".join(each.file.name for each in found)
            raise RecordingError(
                f"{folder} has several calibrations of these joints: {names}",
                cure=Cure("leave the one of the robot that was recorded"),
                file=str(folder),
            )
        if found:
            return found[0]
    return None


def _read(file: Path, joints: Sequence[str]) -> ServoCalibration | None:
    """Return the calibration in a file, None if it is none, or none of these joints."""
    if not file.is_file() or file.stat().st_size > LARGEST_FILE:
        return None
    try:
        content = parse_json(file.read_bytes())
    except (RecordingError, ValueError):
        return None
    if not isinstance(content, dict):
        return None
    servos = {name: servo for name, servo in content.items() if isinstance(servo, dict)}
    fields = ("range_min", "range_max")
    if not set(joints) <= {name for name, servo in servos.items() if set(fields) <= set(servo)}:
        return None
    half_ranges = {name: _measure_range(file, name, servos[name]) for name in joints}
    inverted = frozenset(name for name in joints if servos[name].get("drive_mode"))
    return ServoCalibration(file, half_ranges, inverted)


def _measure_range(file: Path, joint: str, servo: Mapping[str, object]) -> float:
    """Return half the range [rad] of a servo."""
    lower = servo["range_min"]
    upper = servo["range_max"]
    if isinstance(lower, int) and isinstance(upper, int) and lower < upper:
        return (upper - lower) * pi / COUNTS
    raise RecordingError(
        f"{file}: {joint} has the range {str(lower)[:20]} to {str(upper)[:20]}; the first count"
        " must be below the second",
        cure=Cure("calibrate the robot again, or remove the file"),
        file=str(file),
        value=joint,
    )
