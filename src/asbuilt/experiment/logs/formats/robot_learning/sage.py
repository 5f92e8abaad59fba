"""Motions of SAGE (a Sim2Real gap estimator): folders with `control.csv` and `state_motor.csv`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.joint_units import with_open_grippers
from asbuilt.experiment.logs.formats.isolated import read_isolated
from asbuilt.experiment.logs.formats.log_format import FORMATS, LogFormat, LogTable
from asbuilt.experiment.logs.formats.robot_learning.lerobot import LARGEST
from asbuilt.findings import Cure
from asbuilt.untrusted import check_regular, reason

COMMANDS, STATES, NAMES = "control.csv", "state_motor.csv", "joint_list.txt"
MICROSECOND = 1e-6
QUANTITIES = {"positions": "position", "velocities": "velocity", "torques": "torque"}


def read_sage(path: Path) -> LogTable:
    """Read a motion that SAGE logged (isaac-sim2real/sage): lists in cells, times in microseconds.

    The command at the time of a state is the last one sent until then.

    Raises
    ------
    RecordingError
        If a file is missing or damaged, or its lists are not one number per joint.
    """
    names = _joint_names(path / NAMES)
    t, states = _lists(path / STATES, tuple(QUANTITIES), len(names))
    sent, commands = _lists(path / COMMANDS, ("positions",), len(names))
    last = np.searchsorted(sent, t, side="right") - 1
    before = int(np.count_nonzero(last < 0))
    columns: dict[str, Array] = {"time": t * MICROSECOND}
    known: dict[str, tuple[str, str]] = {}
    groups = {QUANTITIES[field]: values for field, values in states.items()}
    groups["command"] = commands["positions"][np.maximum(last, 0)]
    for quantity, values in groups.items():
        for k, name in enumerate(names):
            column = f"{name}/{quantity}"
            columns[column] = np.ascontiguousarray(values[:, k])
            known[column] = (quantity, name)
    notes = (f"{before} states before the first command count as commanded like it",)
    return LogTable(source=str(path), columns=columns, known=known, notes=notes if before else ())


def is_sage(path: Path) -> bool:
    """Return whether a folder is a motion of SAGE."""
    return all((path / name).is_file() for name in (COMMANDS, STATES, NAMES))


def _joint_names(path: Path) -> tuple[str, ...]:
    check_regular(path, "recording", RecordingError, LARGEST)
    names = tuple(line.strip() for line in path.read_text("utf-8", "replace").splitlines())
    names = tuple(name for name in names if name)
    if not names:
        raise RecordingError(f"{path} names no joint", file=str(path))
    return names


def _lists(path: Path, fields: tuple[str, ...], n_joints: int) -> tuple[Array, dict[str, Array]]:
    """Return the times and the lists (N, n) of the fields that a file has."""
    check_regular(path, "recording", RecordingError, LARGEST)
    try:
        frame = pl.read_csv(path, infer_schema=False)
        t = frame["timestamp"].cast(pl.Float64).to_numpy()
        return t, {
            name: _numbers(path, name, frame[name].to_list(), n_joints)
            for name in fields
            if name in frame.columns
        }
    except (pl.exceptions.PolarsError, ValueError, TypeError) as error:
        raise RecordingError(
            f"{path} is not a recording of SAGE ({reason(error)})",
            cure=Cure("export the motion again"),
            file=str(path),
        ) from error


def _numbers(path: Path, field: str, cells: list[str | None], n_joints: int) -> Array:
    values = json.loads(f"[{','.join(cell or 'null' for cell in cells)}]")
    for row, cell in enumerate(values):
        if not isinstance(cell, list) or len(cell) != n_joints:
            raise RecordingError(
                f"{path}: {field} in data row {row + 1} is {str(cell)[:60]}; expected a list of"
                f" {n_joints} numbers",
                file=str(path),
                value=row + 1,
                expected=n_joints,
            )
    return np.array(values, dtype=np.float64).reshape(len(cells), n_joints)


FORMATS.register(
    "sage",
    LogFormat(
        suffixes=(),
        read=lambda path, sheet: with_open_grippers(read_isolated(read_sage, path)),
        folders=True,
        recognises=is_sage,
    ),
)
