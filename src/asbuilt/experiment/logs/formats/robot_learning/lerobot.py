"""LeRobot datasets (v2 and v3): folders of Parquet files with lists, described by a JSON file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.isolated import read_isolated
from asbuilt.experiment.logs.formats.log_format import FORMATS, LogFormat, LogTable
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.findings import Cure
from asbuilt.untrusted import check_regular, reason

INFO = Path("meta") / "info.json"
STATE, ACTION = "observation.state", "action"
LARGEST = 1e9
"""Bytes of the largest file of a dataset that is read."""
GAP = 10.0
"""Time [s] between episodes, whose clocks each begin at zero."""


def read_lerobot(path: Path) -> LogTable:
    """Read states as positions and actions as commands of all episodes, one after another.

    Raises
    ------
    RecordingError
        If a file is missing or damaged, or state and action have other joints.
    """
    info = _info(path / INFO)
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise RecordingError(f"{path} has no Parquet file under data/", file=str(path))
    frame = _frame(files)
    names = {field: _names(path, info, field) for field in (STATE, ACTION) if field in frame}
    if STATE not in names:
        raise RecordingError(
            f"{path} has no feature {STATE!r}; it has {', '.join(frame.columns)}", file=str(path)
        )
    columns: dict[str, Array] = {"time": _times(frame, info)}
    known: dict[str, tuple[str, str]] = {}
    for field, joints in names.items():
        quantity = "position" if field == STATE else "command"
        values = _matrix(path, field, frame[field], len(joints))
        for k, joint in enumerate(joints):
            column = f"{joint}/{quantity}"
            columns[column] = np.ascontiguousarray(values[:, k])
            known[column] = (quantity, joint)
    note = (
        "LeRobot datasets do not say their unit, degrees or -100 to 100 of the calibrated range:"
        " it was taken from the recording sheet"
    )
    return LogTable(source=str(path), columns=columns, known=known, notes=(note,))


def is_lerobot(path: Path) -> bool:
    """Return whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file() and (path / "data").is_dir()


def _info(path: Path) -> Mapping[str, Any]:
    check_regular(path, "recording", RecordingError, LARGEST)
    try:
        info = json.loads(path.read_text("utf-8"))
        if not isinstance(info["features"], dict):
            raise TypeError("features is no object")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordingError(
            f"{path} does not describe a LeRobot dataset ({reason(error)})", file=str(path)
        ) from error
    return dict(info)


def _frame(files: Sequence[Path]) -> pl.DataFrame:
    frames = []
    for file in files:
        check_regular(file, "recording", RecordingError, LARGEST)
        try:
            frames.append(pl.read_parquet(file))
        except (pl.exceptions.PolarsError, OSError) as error:
            raise RecordingError(
                f"{file} cannot be read ({reason(error)})", file=str(file)
            ) from None
    together = pl.concat(frames, how="diagonal_relaxed")
    order = [name for name in ("episode_index", "frame_index") if name in together.columns]
    return together.sort(order) if order else together


def _names(path: Path, info: Mapping[str, Any], field: str) -> tuple[str, ...]:
    """Return the joints of a feature, without the suffix that says position."""
    feature = info["features"].get(field, {})
    names = feature.get("names")
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        count = feature.get("shape", [0])[0]
        names = [f"joint_{k + 1}" for k in range(int(count))]
    if not names:
        raise RecordingError(f"{path} does not name the joints of {field}", file=str(path))
    return tuple(name.removesuffix(".pos").removeprefix("main_") for name in names)


def _times(frame: pl.DataFrame, info: Mapping[str, Any]) -> Array:
    """Return one clock for all episodes, with gaps between them."""
    n = frame.height
    if "timestamp" in frame.columns:
        t = frame["timestamp"].cast(pl.Float64).to_numpy()
    else:
        t = np.arange(n) / float(info.get("fps") or 30.0)
    fresh = np.concatenate([[False], np.diff(t) <= 0.0])
    before = np.concatenate([[0.0], np.where(fresh[1:], t[:-1] - t[1:] + GAP, 0.0)])
    return np.asarray(t + np.cumsum(before))


def _matrix(path: Path, field: str, cells: pl.Series, n_joints: int) -> Array:
    values = cells.to_list()
    if any(not isinstance(row, list | tuple) or len(row) != n_joints for row in values):
        raise RecordingError(
            f"{path}: {field} does not hold {n_joints} numbers in every row",
            cure=Cure("export the dataset again"),
            file=str(path),
            expected=n_joints,
        )
    return np.array(values, dtype=np.float64).reshape(len(values), n_joints)


def _with_unit(table: LogTable, path: Path, sheet: RecordingSheet) -> LogTable:
    """Return the table if its sheet says the unit; raises `RecordingError` otherwise."""
    if sheet.units.position is None:
        largest = max(
            float(np.nanmax(np.abs(values)))
            for name, values in table.columns.items()
            if name.endswith("/position")
        )
        raise RecordingError(
            f"the unit of the positions of {path} is not known: LeRobot logs degrees or -100 to"
            f" 100 of the calibrated range (the largest here is {largest:.3g})",
            cure=Cure(
                'write [units] position = "deg" and command = "deg" in a recording sheet; -100 to'
                " 100 has to be converted with the calibration first"
            ),
            file=str(path),
            value=largest,
        )
    return table


FORMATS.register(
    "lerobot",
    LogFormat(
        suffixes=(),
        read=lambda path, sheet: _with_unit(read_isolated(read_lerobot, path), path, sheet),
        folders=True,
        recognises=is_lerobot,
    ),
)
