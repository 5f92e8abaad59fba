"""Columns of a free base: pose, velocity, contacts and forces, in addition to the joints of a log.

The pose is `base_x base_y base_z` [m] and the quaternion `base_qx base_qy base_qz base_qw` that
turns base axes into world axes. Velocities `base_vx .. base_wz`, if there are any, are in
base axes, as in Pinocchio's free flyer. `contact_NAME` is 1 where the contact is closed.
Measured forces are `contact_NAME_fx .. fz` and `mx .. mz`, and `base_fx .. base_mz`. Where no pose
is logged, columns `imu_..` take its place (`inertial_sensor`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.free_base.feet import (
    find_closed,
    select_force_columns,
    with_measured_forces,
)
from asbuilt.experiment.free_base.inertial_sensor import (
    normalise_quaternions,
    place_on_base,
    with_inertial_base,
)
from asbuilt.experiment.logs.columns.layout import find_column
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure

POSITION = ("base_x", "base_y", "base_z")
QUATERNION = ("base_qx", "base_qy", "base_qz", "base_qw")
ACCELERATION = ("base_ax", "base_ay", "base_az")
ANGULAR_ACCELERATION = ("base_alphax", "base_alphay", "base_alphaz")
LINEAR = ("base_vx", "base_vy", "base_vz")
ANGULAR = ("base_wx", "base_wy", "base_wz")
YAW_OF_PLANAR = "base_yaw"
STEEPEST = np.deg2rad(80.0)
"""Pitch beyond which yaw and roll are one turn, so that their rates say nothing."""


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
    columns = {
        name: values
        for name, values in table.columns.items()
        if name.startswith(("base_", "contact_", "imu_"))
    } | {
        name: table.columns[find_column(table, name, column)]
        for name, column in sheet.columns.by_base.items()
    }
    posed = QUATERNION[0] in columns
    sensed = "imu_wx" in columns
    for group, (problem, cure) in table.unread.items():
        of_contact = group in [f"contact_{contact.frame}" for contact in model.contacts]
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
        placement = place_on_base(table.source, model, frame, "base_frame")
        columns |= move_to_base(columns, placement)
    if posed and sensor:
        # Not needed here, but a frame that a sheet names must be there.
        place_on_base(table.source, model, sensor, "imu_frame")
    recording = replace(recording, extra=columns)
    states = [columns[name] for name in columns if name.startswith(("base_", "imu_"))]
    rows = np.flatnonzero(np.isfinite(states).all(axis=0))
    if table.frames and rows.size:
        inside = slice(int(rows[0]), int(rows[-1]) + 1)
        left_out = recording.n_samples - (inside.stop - inside.start)
        note = f"{left_out} samples without a state of the base, before or after it, were left out"
        if left_out:
            recording = replace(recording.taken(inside), notes=(*recording.notes, note))
    return recording, sensor


def move_to_base(columns: Mapping[str, Array], placement: Array) -> dict[str, Array]:
    """Return pose and twist of a base, given of a frame at `placement` (4, 4) on it.

    With R, p of the frame on the base: `R_base = R_frame R^T`, `x_base = x_frame - R_base p`, and
    in axes of the base `w_base = R w_frame`, `v_base = R v_frame - w_base x p`, as are their rates.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - light start

    R = placement[:3, :3]  # SciPy takes none that is read-only
    p = placement[:3, 3].copy()
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


def add_base_coordinates(recording: Recording, model: RobotModel, sensor: str = "") -> Recording:
    """Return a recording of the joints with the coordinates of the base before them.

    The columns of the base are among its `extra`. `sensor` is the link or frame of its inertial
    sensor; "": `imu`, `imu_link` or the base. In a log of commands measured forces at contacts say
    when these are closed, and are projected away.

    Raises
    ------
    RecordingError
        If a column is missing, a quaternion has not the length 1, the base pitches to 90 degrees,
        or a log of commands has forces on the base.
    """
    if recording.drive_law is not None and "base_fx" in recording.extra:
        raise RecordingError(
            f"{recording.source} has forces on the base (base_fx) and commands in place of torques,"
            " to which measured forces are not added",
            cure=Cure("log torques, or leave the forces out if nothing pushes the base"),
            file=recording.source,
        )
    if any(name.startswith("imu_") for name in recording.extra):
        recording = with_inertial_base(recording, model, sensor)
    contact = _find_closed_contacts(recording, model) if model.contacts else None
    q, notes = _read_pose(recording, model)
    qd, qdd = _read_rates(recording, model, q)
    recording = replace(
        recording,
        notes=(*recording.notes, *notes),
        extra=select_force_columns(recording.extra),
        contact=contact,
    )
    found = recording.behind(model.joint_names[: model.n_floating], q, qd, qdd)
    return with_measured_forces(found, model) if found.drive_law is None else found


def _find_closed_contacts(recording: Recording, model: RobotModel) -> Array:
    """Return where contacts are closed (N, n_contacts), by their flag or else by their force."""

    def closed(frame: str) -> Array:
        found = find_closed(recording.extra, frame)
        why = "which says when the contact is closed"
        return (
            _stack_columns(recording, [f"contact_{frame}"], why)[:, 0] if found is None else found
        )

    return np.stack([closed(contact.frame) for contact in model.contacts], axis=1)


def _stack_columns(recording: Recording, names: list[str] | tuple[str, ...], what: str) -> Array:
    """Return columns (N, len(names)); raises `RecordingError` where one is missing."""
    missing = [name for name in names if name not in recording.extra]
    if missing:
        raise RecordingError(
            f"{recording.source} has no column {missing[0]!r}, {what}; a free base needs"
            f" {' '.join((*POSITION, *QUATERNION))}, or an inertial sensor (imu_wx .., imu_ax ..),"
            " and contact_NAME of every contact, or its force contact_NAME_fx, _fy, _fz",
            cure=Cure("add it to the log, or rename the column"),
            file=recording.source,
            value=missing,
            available=list(recording.extra),
        )
    return np.stack([recording.extra[name] for name in names], axis=1)


def _read_pose(recording: Recording, model: RobotModel) -> tuple[Array, list[str]]:
    """Return the coordinates of the base (N, n_floating), and notes."""
    if model.n_floating == 3 and YAW_OF_PLANAR in recording.extra:
        pose = _stack_columns(recording, (*POSITION[:2], YAW_OF_PLANAR), "a coordinate of the base")
        return np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])]), []
    position = _stack_columns(
        recording, POSITION[: 2 if model.n_floating == 3 else 3], "where the base is"
    )
    logged = _stack_columns(recording, QUATERNION, "how the base is turned")
    quaternion, notes = normalise_quaternions(recording, logged, QUATERNION)
    angles = yaw_pitch_roll(quaternion)
    if model.n_floating == 3:
        return np.column_stack([position, np.unwrap(angles[:, 0])]), notes
    steep = np.abs(angles[:, 1]) > STEEPEST
    if steep.any():
        first = int(np.flatnonzero(steep)[0])
        pitch, most = np.rad2deg([angles[first, 1], STEEPEST])
        raise RecordingError(
            f"{recording.source}: the base pitches to {pitch:.0f} deg at sample {first}, where yaw"
            f" and roll are one turn; at most {most:.0f} deg are read",
            cure=Cure(
                "leave those samples out, or check that the columns are base_qx, qy, qz and qw"
            ),
            file=recording.source,
            value=float(angles[first, 1]),
        )
    return np.column_stack([position, np.unwrap(angles, axis=0)]), notes


def yaw_pitch_roll(quaternion: Array) -> Array:
    """Return the angles (N, 3) of quaternions x y z w: turns about z, then y, then x.

    >>> yaw_pitch_roll(np.array([[0.0, 0.0, 0.6, 0.8]])).round(4).tolist()
    [[1.287, 0.0, 0.0]]
    """
    x, y, z, w = quaternion.T
    return np.stack(
        [
            np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
            np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        ],
        axis=1,
    )


def _read_rates(
    recording: Recording, model: RobotModel, q: Array
) -> tuple[Array | None, Array | None]:
    """Return the first and second rates of the base's coordinates; None if they are not logged."""
    known = recording.extra

    def logged(*groups: tuple[str, ...]) -> list[Array]:
        if model.n_floating != 6 or not set(sum(groups, ())) <= known.keys():
            return []
        return [np.stack([known[name] for name in names], axis=1) for names in groups]

    twist = logged(LINEAR, ANGULAR)
    if not twist:
        return None, None
    change = logged(ACCELERATION, ANGULAR_ACCELERATION)
    first = coordinate_rates(q, *twist)
    return first, coordinate_accelerations(q, first, *twist, *change) if change else None


def coordinate_rates(q: Array, v: Array, w: Array) -> Array:
    """Return the rates (N, 6) of the base's coordinates of velocities (N, 3) in base axes.

    With R of yaw, pitch and roll: `d(x, y, z)/dt = R v`, and the rates of the angles follow from
    `w = roll' x + pitch' Rx^T y + yaw' (Ry Rx)^T z`.
    """
    sp, sr = np.sin(q[:, 4:6]).T
    cp, cr = np.cos(q[:, 4:6]).T
    yaw = (sr * w[:, 1] + cr * w[:, 2]) / cp
    pitch = cr * w[:, 1] - sr * w[:, 2]
    roll = w[:, 0] + sp * yaw
    return np.column_stack([np.einsum("sij,sj->si", base_rotations(q), v), yaw, pitch, roll])


def find_base_spin(q: Array, rates: Array) -> Array:
    """Return the angular velocity (N, 3) in base axes of rates of the base's coordinates.

    The inverse of `coordinate_rates`.
    """
    sp, sr = np.sin(q[:, 4:6]).T
    cp, cr = np.cos(q[:, 4:6]).T
    yaw, pitch, roll = rates[:, 3:6].T
    across = cp * yaw
    return np.column_stack([roll - sp * yaw, cr * pitch + sr * across, cr * across - sr * pitch])


def coordinate_accelerations(
    q: Array, rates: Array, v: Array, w: Array, a: Array, alpha: Array
) -> Array:
    """Return the second rates (N, 6) of the base's coordinates.

    `a` and `alpha` are the rates of change of v and w in base axes, so that the base accelerates by
    `R (a + w x v)`; the second rates of the angles are the derivatives of the sums in
    `coordinate_rates`.
    """
    sp, sr = np.sin(q[:, 4:6]).T
    cp, cr = np.cos(q[:, 4:6]).T
    yaw, pitch, roll = rates[:, 3:].T
    across = sr * alpha[:, 1] + cr * alpha[:, 2] + roll * pitch
    yaws = (across + yaw * sp * pitch) / cp
    pitches = cr * alpha[:, 1] - sr * alpha[:, 2] - roll * yaw * cp
    rolls = alpha[:, 0] + cp * pitch * yaw + sp * yaws
    linear = np.einsum("sij,sj->si", base_rotations(q), a + np.cross(w, v))
    return np.column_stack([linear, yaws, pitches, rolls])


def base_rotations(q: Array) -> Array:
    """Return the rotations from base axes to world axes, (N, 3, 3)."""
    cy, cp, cr = np.cos(q[:, 3:6]).T
    sy, sp, sr = np.sin(q[:, 3:6]).T
    R = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(R), 2, 0)
