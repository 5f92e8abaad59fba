"""Base of a robot on legs from an inertial sensor and its feet, where its pose is not logged.

`imu_wx .. imu_wz` [rad/s] and the specific force `imu_ax .. imu_az` [m/s^2] (9.81 upwards at rest)
are in axes of the sensor, as is the quaternion `imu_qx .. imu_qw` that turns them into axes of the
world, if there is one. The sensor is at the link or frame `imu` or `imu_link`, or else at the base.

Equations of motion depend on how the base is turned, on its angular velocity and on both
accelerations, not on where it is. The sensor measures accelerations; feet that stand still say
how fast the base moves, which takes away what integrals of the sensor drift by (Bloesch et al.,
State estimation for legged robots, RSS 2012, by a filter in place of our zero-phase one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.free_base.feet import (
    RULES,
    Feet,
    estimate_base_velocity,
    integrate,
    select_slow_part,
)
from asbuilt.experiment.free_base.sensor_checks import (
    make_sensor_error,
    normalise_quaternions,
    refuse_force,
    refuse_heading,
    refuse_rates,
    refuse_turn,
    refuse_units,
)
from asbuilt.experiment.recording import Recording

ANGULAR = ("imu_wx", "imu_wy", "imu_wz")
FORCE = ("imu_ax", "imu_ay", "imu_az")
QUATERNION = ("imu_qx", "imu_qy", "imu_qz", "imu_qw")
PLACES = ("imu", "imu_link")


def with_inertial_base(recording: Recording, model: RobotModel, sensor: str = "") -> Recording:
    """Return a recording with columns of the base from the columns of an inertial sensor.

    The link or frame `sensor` has it; "": `imu`, `imu_link` or the base. Nothing changes where the
    log has a pose of the base, or no sensor.

    Raises
    ------
    RecordingError
        If columns of the sensor are missing, or gravity and feet contradict its axes, units or
        sign.
    """
    known = recording.extra
    if "base_qx" in known or not known.keys() & {*ANGULAR, *FORCE} or model.n_floating != 6:
        return recording
    missing = [name for name in (*ANGULAR, *FORCE) if name not in known]
    if missing:
        raise make_sensor_error(
            recording,
            f"has an inertial sensor, but no column {missing[0]!r}",
            f"log {' '.join((*ANGULAR, *FORCE))}, or the pose of the base",
        )
    w, f = (np.stack([known[name] for name in names], axis=1) for names in (ANGULAR, FORCE))
    if not (np.isfinite(w).all() and np.isfinite(f).all() and np.all(np.diff(recording.t) > 0.0)):
        raise make_sensor_error(
            recording,
            "has an inertial sensor with missing values, or a clock that does not advance, so that"
            " it cannot be integrated",
            "log every sample, or give the parts without gaps as separate recordings",
        )
    refuse_units(recording, f, float(np.linalg.norm(model.gravity)))
    placement, where = _place_sensor(recording, model, (sensor,) if sensor else PLACES)
    w = w @ placement[:3, :3].T
    f = f @ placement[:3, :3].T
    feet = Feet.of(recording, model)
    refuse_force(recording, feet, f)
    R = None
    if set(QUATERNION) <= known.keys():
        logged = _read_rotations(recording)
        R, inverse = (x @ placement[:3, :3].T for x in (logged, np.swapaxes(logged, 1, 2)))
        refuse_turn(recording, feet, R, inverse, w, f)
    refuse_rates(recording, feet, w, f, R)
    arm = placement[:3, 3]
    dt = 1.0 / recording.rate
    alpha = np.gradient(w, recording.t, axis=0)
    f = f - np.cross(alpha, arm) - np.cross(w, np.cross(w, arm))
    if R is None:
        R = _level(_integrate_turn(w, f, dt), f, feet, w, recording.rate)
    v, offset = estimate_base_velocity(R, f, feet, w, recording.rate, model.gravity)
    refuse_heading(recording, feet, R, f, w, v, model.gravity)
    columns = _make_base_columns(R, v, w, alpha, f - offset, model.gravity, dt)
    note = f"the motion of the base is from the inertial sensor at {where} and the feet that stand"
    return replace(recording, extra=dict(known) | columns, notes=(*recording.notes, note))


def _level(R: Array, f: Array, feet: Feet, w: Array, rate: float) -> Array:
    """Return rotations (N, 3, 3) whose slow tilt agrees with gravity."""
    own, count = feet.base_velocity(w)
    for _ in range(RULES.updates):
        moved = np.einsum("sij,sj->si", R, own)
        moved[count == 0] = 0.0
        force = np.einsum("sij,sj->si", R, f) - np.gradient(moved, 1.0 / rate, axis=0)
        up = select_slow_part(force, RULES.tilt, rate)
        up /= np.linalg.norm(up, axis=1)[:, None]
        R = Rotation.from_rotvec(np.cross(up, [0.0, 0.0, 1.0])).as_matrix() @ R
    return R


def _integrate_turn(w: Array, f: Array, dt: float) -> Array:
    """Return rotations (N, 3, 3) that begin upright by f and turn by w (N, 3) in their own axes."""
    start = Rotation.align_vectors([[0.0, 0.0, 1.0]], f[:50].mean(axis=0)[None])[0].as_matrix()
    steps = Rotation.from_rotvec(0.5 * dt * (w[1:] + w[:-1])).as_matrix()
    found = np.empty((len(w), 3, 3))
    found[0] = start
    for k, step in enumerate(steps):
        found[k + 1] = found[k] @ step
    return np.asarray(Rotation.from_matrix(found).as_matrix())


def _make_base_columns(
    R: Array, v: Array, w: Array, alpha: Array, f: Array, gravity: Array, dt: float
) -> dict[str, Array]:
    """Return the columns of a base with velocities v (N, 3) in world axes, w in its own.

    `base_a` is the rate of change of the velocity in base axes, which is `R^T a - w x R^T v`.
    """
    place = integrate(v, dt)
    own = np.einsum("sji,sj->si", R, v)
    a = f + np.einsum("sji,j->si", R, gravity) - np.cross(w, own)
    turn = Rotation.from_matrix(R).as_quat()
    signs = np.cumprod(np.r_[1.0, np.where(np.sum(turn[1:] * turn[:-1], axis=1) < 0.0, -1.0, 1.0)])
    groups = {"base_": place, "base_v": own, "base_w": w, "base_a": a, "base_alpha": alpha}
    found = {
        f"{group}{axis}": values[:, k]
        for group, values in groups.items()
        for k, axis in enumerate("xyz")
    }
    return found | {f"base_q{axis}": (turn.T * signs)[k] for k, axis in enumerate("xyzw")}


def _read_rotations(recording: Recording) -> Array:
    """Return the rotations (N, 3, 3) of the logged quaternion; refuses one of another length."""
    quaternion = np.stack([recording.extra[name] for name in QUATERNION], axis=1)
    return np.asarray(
        Rotation.from_quat(normalise_quaternions(recording, quaternion, QUATERNION)[0]).as_matrix()
    )


def _place_sensor(
    recording: Recording, model: RobotModel, places: Sequence[str]
) -> tuple[Array, str]:
    """Return the placement (4, 4) of the sensor in the base, and its name."""
    base = model.n_floating - 1
    for name in places:
        if name in model.link_names or name in {frame.name for frame in model.frames}:
            link, placement = model.placed(name)
            if link != base:
                raise make_sensor_error(
                    recording,
                    f"has an inertial sensor, and {name} of {model.name} is not fixed to its base",
                    "log the sensor of the base, or its pose",
                )
            return placement, name
    return np.eye(4), model.link_names[base]
