"""Joint states as `ros2 topic echo --csv` prints them: no header, names in every line.

A line has seconds, nanoseconds, the frame, the names of the joints, then positions, velocities and
efforts; an empty field stands for an empty array.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.formats.ros.joint_table import tabulate_joint_states
from asbuilt.experiment.logs.formats.ros.messages import JointMessage, TopicChoices, Topics
from asbuilt.findings import Cure

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)


def is_topic_echo(line: str) -> bool:
    """Return whether a line of a file without header is an echoed joint state."""
    return _parse_line(line) is not None


def read_topic_echo(path: Path) -> LogTable:
    """Read a file of echoed joint states; joints are matched by name in every line.

    Raises
    ------
    RecordingError
        If a line is no joint state, or none has an effort.
    """
    states: list[JointMessage] = []
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            state = _parse_line(line)
            if state is not None:
                states.append(state)
            elif line.strip() not in ("", "---"):
                raise RecordingError(
                    f"{path}, line {number}: it is not a joint state",
                    cure=Cure("remove the line"),
                    file=str(path),
                    line=number,
                )
    return tabulate_joint_states(Topics(path, {}, "the file", None), states, [], TopicChoices())


def _parse_line(line: str) -> JointMessage | None:
    """Return the joint state of a line; None if it is none."""
    fields = [field.strip() for field in line.strip("\r\n").split(",")]
    if len(fields) < 7 or not (fields[0].isdigit() and fields[1].isdigit()):
        return None
    numeric = [k for k in range(3, len(fields)) if not fields[k] or _NUMBER.fullmatch(fields[k])]
    first = numeric[0] if numeric else len(fields)
    names, rest = tuple(fields[3:first]), fields[first:]
    values = []
    for _ in range(3):
        count = len(names) if rest and rest[0] else 1
        values.append(rest[:count] if rest and rest[0] else [])
        full, rest = len(rest) >= count, rest[count:]
        if not full or not all(map(_NUMBER.fullmatch, values[-1])):
            return None
    if rest or not names or len(set(names)) < len(names):
        return None
    stamp = int(fields[0]) * 10**9 + int(fields[1])
    q, qd, tau = (np.array(each, dtype=np.float64) for each in values)
    return JointMessage(stamp, stamp, names, q, qd, tau)
