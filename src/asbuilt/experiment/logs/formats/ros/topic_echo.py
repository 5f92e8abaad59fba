"""Joint states as `ros2 topic echo --csv` prints them: no header, names in every line.

A line has seconds, nanoseconds, the frame, the names of the joints, then positions, velocities and
efforts; an empty field stands for an empty array.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable, tabulate_joints
from asbuilt.experiment.logs.formats.ros.messages import FIELDS
from asbuilt.findings import Cure


def is_topic_echo(line: str) -> bool:
    """Return whether a line of a file without header is an echoed joint state."""
    return _parse_line(line) is not None


def read_topic_echo(path: Path) -> LogTable:
    """Read a file of echoed joint states; joints are matched by name in every line.

    Raises
    ------
    RecordingError
        If a line is no joint state, names other joints than the first, or has no effort.
    """
    times: list[int] = []
    rows: list[Array] = []
    joints: tuple[str, ...] = ()
    for number, line in _read_lines(path):
        parsed = _parse_line(line)
        if parsed is None:
            raise _make_line_error(path, number, "is not a joint state")
        stamp, names, values = parsed
        joints = joints or names
        if set(names) != set(joints):
            raise _make_line_error(path, number, f"names the joints {', '.join(names)}")
        times.append(stamp)
        rows.append(values[:, [names.index(name) for name in joints]])
    values = np.array(rows)
    if np.all(np.isnan(values[:, 2])):
        raise RecordingError(
            f"{path}: the joint states of {', '.join(joints)} have no effort; torques or currents"
            " are required",
            file=str(path),
        )
    stamps = np.array(times, dtype=np.int64)
    groups = [
        (field, quantity, joints, values[:, which])
        for which, (field, quantity) in enumerate(FIELDS)
        if not np.all(np.isnan(values[:, which]))
    ]
    return tabulate_joints(str(path), (stamps - stamps[0]).astype(np.float64) * 1e-9, groups)


def _read_lines(path: Path) -> Iterator[tuple[int, str]]:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            if line.strip() and line.strip() != "---":
                yield number, line


def _parse_line(line: str) -> tuple[int, tuple[str, ...], Array] | None:
    """Return nanoseconds, names and values (3, n) of a line; None if it is no joint state."""
    fields = [field.strip() for field in line.strip("\r\n").split(",")]
    if len(fields) < 7 or not (fields[0].isdigit() and fields[1].isdigit()):
        return None
    first = next((k for k in range(3, len(fields)) if _is_number(fields[k])), len(fields))
    while first > 3 and not fields[first - 1]:
        first -= 1
    names = tuple(fields[3:first])
    if not names or not all(names) or len(set(names)) < len(names):
        return None
    values, rest = np.full((3, len(names)), np.nan), fields[first:]
    for which in range(3):
        if not rest:
            return None
        taken = 1 if not rest[0] else len(names)
        if rest[0]:
            try:
                values[which] = [float(field) for field in rest[:taken]]
            except ValueError:
                return None
        rest = rest[taken:]
    return (int(fields[0]) * 10**9 + int(fields[1]), names, values) if not rest else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _make_line_error(path: Path, number: int, what: str) -> RecordingError:
    return RecordingError(
        f"{path}, line {number}: it {what}",
        cure=Cure("remove the line"),
        file=str(path),
        line=number,
    )
