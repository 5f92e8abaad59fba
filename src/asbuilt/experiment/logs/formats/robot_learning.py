"""Logs of robot learning: LeRobot datasets (v2 and v3) with their calibration, and motions of SAGE.

LeRobot logs the counts of an encoder either as degrees from the middle of the calibrated range, or
as -100 to 100 of that range, and grippers as 0 (closed) to 100 (open). Which one, a dataset does
not say; the calibration and the largest numbers together often do.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lazy_loader
import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.joint_matching import names_gripper
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogTable,
    hold_last,
    isolate,
    tabulate_joints,
)
from asbuilt.experiment.logs.sheet import RATES
from asbuilt.findings import Cure
from asbuilt.isolated_reading import FileKind
from asbuilt.untrusted import parse_json, shorten_line

if TYPE_CHECKING:
    import polars as pl
else:
    pl = lazy_loader.load("polars")

INFO = Path("meta") / "info.json"
STATE = "observation.state"
ACTION = "action"
OTHERS = (".vel", ".acc", ".effort", ".torque", ".current", ".load", ".temp")
"""Ends of features that are no positions; their units are not known either."""


def read_lerobot(path: Path) -> LogTable:
    """Read states as positions and actions as commands of all episodes, one after another.

    Raises
    ------
    RecordingError
        If a file or a feature is missing, or a feature does not hold one number per joint.
    """
    info = _read_info(path / INFO)
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise RecordingError(f"{path} has no Parquet file under data/", file=str(path))
    frame = pl.concat([pl.read_parquet(file) for file in files], how="diagonal_relaxed")
    order = [name for name in ("episode_index", "frame_index") if name in frame.columns]
    frame = frame.sort(order) if order else frame
    if STATE not in frame:
        raise RecordingError(
            f"{path} has no feature {STATE!r}; it has {', '.join(frame.columns)}", file=str(path)
        )
    groups = list[tuple[str, str, Sequence[str], Array]]()
    left_out = list[str]()
    for field, quantity in ((STATE, "position"), (ACTION, "command")):
        if field not in frame:
            continue
        inner = getattr(frame[field].dtype, "inner", None)
        if inner is None or not inner.is_numeric():
            raise _make_feature_error(path, field, f"{frame[field].dtype}, not lists of numbers")
        rows = frame[field].to_list()
        names = _find_names(path, info, field, rows)
        values = _stack_rows(path, field, rows, len(names))
        kept = [k for k, name in enumerate(names) if not name.endswith(OTHERS)]
        joints = [names[k].removesuffix(".pos").removeprefix("main_") for k in kept]
        left_out += [f"{field} {name}" for name in names if name.endswith(OTHERS)]
        groups.append((quantity, quantity, joints, values[:, kept]))
    _, _, measured, positions = groups[0]
    calibration = find_calibration(path, measured)
    notes = [f"features that are no positions were left out: {', '.join(left_out)}"]
    table = tabulate_joints(
        str(path), _join_times(path, frame, info), groups, notes if left_out else []
    )
    if calibration is None:
        note = (
            "LeRobot datasets do not say their unit, degrees or -100 to 100 of the calibrated"
            " range: it was taken from the recording sheet"
        )
        return replace(table, open_units=tuple(table.known), notes=(note, *table.notes))
    return _apply_calibration(table, calibration, calibration.find_unit(measured, positions))


def _apply_calibration(table: LogTable, calibration: ServoCalibration, unit: str) -> LogTable:
    """Return the table with the positions that its numbers are; joints stay open without unit."""
    ranges = {
        column: calibration.find_range(joint, unit)
        for column, (_, joint) in table.known.items()
        if joint in calibration.half_ranges
    }
    known = {column for column in ranges if unit or names_gripper(table.known[column][1])}
    units = {"deg": "degrees", "percent": "-100 to 100 of the range of each joint"}
    notes = [
        f"{calibration.file.name} has the calibrated ranges: positions are {units[unit]}"
        if unit
        else f"{calibration.file.name} has the calibrated ranges, but the motion fits degrees and"
        " -100 to 100 of them alike: the unit was taken from the recording sheet"
    ]
    if any(names_gripper(joint) for joint in calibration.half_ranges):
        notes.append("the gripper is 0 rad where it is closed, the end 0 of its scale")
    return replace(
        table,
        ranges=ranges,
        open_units=tuple(column for column in table.known if column not in known),
        notes=(*notes, *table.notes),
    )


def is_lerobot(path: Path) -> bool:
    """Return whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file() and (path / "data").is_dir()


def _read_info(path: Path) -> Mapping[str, Any]:
    info: dict[str, Any] = parse_json(path.read_bytes())
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict) or not all(isinstance(x, dict) for x in features.values()):
        raise RecordingError(
            f"{path} does not describe a LeRobot dataset (it has no object 'features' of objects)",
            file=str(path),
        )
    return info


def _find_names(
    path: Path, info: Mapping[str, Any], field: str, rows: Sequence[Any]
) -> tuple[str, ...]:
    """Return the names of the numbers of a feature."""
    names = info["features"].get(field, {}).get("names")
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        first = next((row for row in rows if row is not None), ())
        names = [f"joint_{k + 1}" for k in range(len(first))]
    if not names:
        raise RecordingError(f"{path} does not name the joints of {field}", file=str(path))
    return tuple(names)


def _join_times(path: Path, frame: pl.DataFrame, info: Mapping[str, Any]) -> Array:
    """Return one clock for all episodes, with gaps between them.

    It comes from the time stamps, or without them from the frames at `fps`.
    """
    stamps = frame["timestamp"] if "timestamp" in frame.columns else pl.Series([None])
    if stamps.dtype.is_numeric() and stamps.null_count() < frame.height:
        t = stamps.cast(pl.Float64).to_numpy()
    elif RATES.holds(info.get("fps")):
        counted = frame["frame_index"] if "frame_index" in frame.columns else range(frame.height)
        t = np.asarray(counted) / float(info["fps"])
    else:
        raise RecordingError(
            f"{path} has no time: no time stamps, and no fps in {INFO} (a number {RATES})",
            cure=Cure(f'write "fps" into {INFO}'),
            file=str(path),
            value=shorten_line(str(info.get("fps"))),
        )
    fresh = np.concatenate([[False], np.diff(t) <= 0.0])
    # Time [s] between episodes, whose clocks each begin at zero.
    before = np.concatenate([[0.0], np.where(fresh[1:], t[:-1] - t[1:] + 10.0, 0.0)])
    return np.asarray(t + np.cumsum(before))


def _stack_rows(path: Path, field: str, rows: Sequence[Any], n_joints: int) -> Array:
    """Return lists of one number per joint as a matrix (N, n)."""
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, list) or len(row) != n_joints:
            got = f"{str(row)[:60]} in row {number}, not {n_joints} numbers"
            raise _make_feature_error(path, field, got)
    return np.array(rows, dtype=np.float64).reshape(len(rows), n_joints)


def _make_feature_error(path: Path, field: str, what: str) -> RecordingError:
    cure = Cure("export the dataset again")
    return RecordingError(f"{path}: {field} holds {what}", cure=cure, file=str(path))


FORMATS.register(
    "lerobot",
    LogFormat(
        suffixes=(),
        read=isolate(
            read_lerobot,
            FileKind(
                "a LeRobot dataset", cure="export the dataset again", reads=(".parquet", ".json")
            ),
        ),
        folders=True,
        recognises=is_lerobot,
    ),
)


COMMANDS = "control.csv"
STATES = "state_motor.csv"
NAMES = "joint_list.txt"
SAGE_FIELDS = {"positions": "position", "velocities": "velocity", "torques": "torque"}


def read_sage(path: Path) -> LogTable:
    """Read a motion that SAGE logged: lists in cells, times in microseconds.

    The command at the time of a state is the last one sent until then.

    Raises
    ------
    RecordingError
        If no joint is named, or lists are not one number per joint.
    """
    lines = (path / NAMES).read_text("utf-8", "replace").splitlines()
    names = tuple(name for line in lines if (name := line.strip()))
    if not names:
        raise RecordingError(f"{path / NAMES} names no joint", file=str(path))
    t, states = _read_list_cells(path / STATES, tuple(SAGE_FIELDS), len(names))
    sent, commands = _read_list_cells(path / COMMANDS, ("positions",), len(names))
    groups = {SAGE_FIELDS[field]: values for field, values in states.items()}
    groups["command"], notes = hold_last(t, sent, commands["positions"])
    listed = [(quantity, quantity, names, values) for quantity, values in groups.items()]
    table = tabulate_joints(str(path), t * 1e-6, listed, notes)
    grippers = [column for column, (_, joint) in table.known.items() if names_gripper(joint)]
    return replace(table, open_units=tuple(grippers))


def is_sage(path: Path) -> bool:
    """Return whether a folder is a motion of SAGE."""
    return all((path / name).is_file() for name in (COMMANDS, STATES, NAMES))


def _read_list_cells(
    path: Path, fields: tuple[str, ...], n_joints: int
) -> tuple[Array, dict[str, Array]]:
    """Return the times and the lists (N, n) of the fields that a file has."""
    frame = pl.read_csv(path, infer_schema=False)
    cells = {
        name: json.loads(f"[{','.join(cell or 'null' for cell in frame[name])}]")
        for name in fields
        if name in frame.columns
    }
    values = {name: _stack_rows(path, name, rows, n_joints) for name, rows in cells.items()}
    return frame["timestamp"].cast(pl.Float64).to_numpy(), values


FORMATS.register(
    "sage",
    LogFormat(
        suffixes=(),
        read=isolate(
            read_sage,
            FileKind("a motion of SAGE", cure="export the motion again", reads=(".csv", ".txt")),
        ),
        folders=True,
        recognises=is_sage,
    ),
)


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
