"""Columns of a floating base from a log and its sheet, in axes of the base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError, RecordingError
from asbuilt.experiment.free_base.columns import (
    ACCELERATION,
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    POSITION,
    QUATERNION,
    select_base_columns,
)
from asbuilt.experiment.logs.columns.layout import find_column
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure


def with_base_columns(
    recording: Recording, table: LogTable, sheet: RecordingSheet, model: RobotModel
) -> tuple[Recording, str]:
    """Return the recording with columns of the base as its `extra`, and the frame of its sensor.

    Pose and twist of another frame that is fixed to the base are moved to the base. Samples before
    the first and after the last state of the base are left out.

    Raises
    ------
    RecordingError
        If the source of a state that is needed cannot be read, or a frame is not fixed to the base.
    """
    names = tuple(table.columns)
    columns = select_base_columns(table.columns) | {
        name: table.columns[find_column(table.source, names, table.order, name, column)]
        for name, column in sheet.columns.by_base.items()
    }
    posed, sensed = QUATERNION[0] in columns, "imu_wx" in columns
    for group, (problem, cure) in table.unread.items():
        of_contact = group in [f"contact_{each.frame}" for each in model.contacts]
        if of_contact or not (posed or sensed):
            raise RecordingError(problem, cure=Cure(cure), file=table.source)
        if group == "base" and not posed:
            note = f"{problem}; its inertial sensor gives the base"
            recording = replace(recording, notes=(*recording.notes, note))
    world = table.frames.get("world", "").rpartition("/")[2]
    if posed and world in {*model.link_names, *(frame.name for frame in model.frames)}:
        raise RecordingError(
            f"{table.source}: the pose of the base is in axes of {world!r}, a part of {model.name},"
            " and not of the world",
            cure=Cure("record the pose in a frame that stands still, such as odom or map"),
            file=table.source,
            value=world,
        )
    frame = sheet.base_frame or table.frames.get("base", "")
    sensor = sheet.imu_frame or ("" if posed else table.frames.get("imu", ""))
    if posed and frame:
        placement = _place_on_base(table, model, frame, "base_frame")
        columns |= move_to_base(columns, placement)
    if sensor:
        _place_on_base(table, model, sensor, "imu_frame")
    recording = replace(recording, extra=columns)
    states = [columns[name] for name in columns if name.startswith(("base_", "imu_"))]
    rows = np.flatnonzero(np.isfinite(states).all(axis=0))
    if table.frames and rows.size:
        inside = slice(int(rows[0]), int(rows[-1]) + 1)
        left_out = recording.n_samples - (inside.stop - inside.start)
        note = f"{left_out} samples without a state of the base, before or after it, were left out"
        if left_out:
            recording = replace(recording.taken(inside), notes=(*recording.notes, note))
    return recording, sensor.rpartition("/")[2]


def _place_on_base(table: LogTable, model: RobotModel, frame: str, field: str) -> Array:
    """Return the placement (4, 4) of a frame on the base; refuses one that is not fixed to it."""
    base = model.n_floating - 1
    try:
        link, placement = model.placed(frame.rpartition("/")[2])
    except DescriptionError:
        link, placement = -1, np.eye(4)
    if link != base:
        fixed = [each.name for each in model.frames if each.link == base]
        listed = ", ".join([model.link_names[base], *fixed])
        raise RecordingError(
            f"{table.source}: the frame {frame!r} is not fixed to the base of {model.name}; its"
            f" base has {listed}",
            cure=Cure(
                "say which of them it is in a recording sheet, or add it to the description:"
                f' {field} = "{model.link_names[base]}"'
            ),
            file=table.source,
            value=frame,
            available=[model.link_names[base], *fixed],
        )
    return placement


def move_to_base(columns: Mapping[str, Array], placement: Array) -> dict[str, Array]:
    """Return pose and twist of a base, given of a frame at `placement` (4, 4) on it.

    With R, p of the frame on the base: `R_base = R_frame R^T`, `x_base = x_frame - R_base p`, and
    in axes of the base `w_base = R w_frame`, `v_base = R v_frame - w_base x p`, as are their rates.
    """
    R, p = placement[:3, :3], placement[:3, 3].copy()  # SciPy takes none that is read-only
    found: dict[str, Array] = {}

    def stack(names: tuple[str, ...]) -> Array:
        return np.stack([columns[name] for name in names], axis=1)

    if set(QUATERNION) <= columns.keys() and set(POSITION) <= columns.keys():
        logged = stack(QUATERNION)
        length = np.linalg.norm(logged, axis=1)
        known = length > 0.0  # neither zero nor NaN
        turn = np.full(logged.shape, np.nan)
        turned = Rotation.from_quat(logged[known]) * Rotation.from_matrix(R).inv()
        turn[known] = turned.as_quat() * length[known, None]
        place = np.full((len(turn), 3), np.nan)
        place[known] = stack(POSITION)[known] - turned.apply(p)
        found |= zip((*POSITION, *QUATERNION), (*place.T, *turn.T), strict=True)
    for linear, angular in ((LINEAR, ANGULAR), (ACCELERATION, ANGULAR_ACCELERATION)):
        if {*linear, *angular} <= columns.keys():
            w = stack(angular) @ R.T
            v = stack(linear) @ R.T - np.cross(w, p)
            found |= zip((*linear, *angular), (*v.T, *w.T), strict=True)
    return found
