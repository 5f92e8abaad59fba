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

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import rotation_z
from asbuilt.errors import RecordingError
from asbuilt.experiment.free_base.feet import (
    RULES,
    Feet,
    estimate_base_velocity,
    integrate,
    select_slow_part,
)
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure

ANGULAR = ("imu_wx", "imu_wy", "imu_wz")
FORCE = ("imu_ax", "imu_ay", "imu_az")
QUATERNION = ("imu_qx", "imu_qy", "imu_qz", "imu_qw")
PLACES = ("imu", "imu_link")
INVERSE = "the inverse of a rotation: so read, it turns as imu_wx .. imu_wz say"
FORWARD = "log the quaternion x y z w that turns axes of the sensor into axes of the world"
UNIT_LENGTH = 0.02
"""Largest deviation of a quaternion's length from 1 that is rounding or drift of an estimator."""


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


# Checks of units, sign and axes by gravity, orientation and feet that stand: each refuses a reading
# that the log contradicts, and names one that agrees with it.


def normalise_quaternions(
    recording: Recording, quaternion: Array, names: Sequence[str]
) -> tuple[Array, list[str]]:
    """Return quaternions (N, 4), x y z w, of length 1, and notes; refuses those that are not."""
    length = np.linalg.norm(quaternion, axis=1)
    off = np.abs(length - 1.0)
    worst = int(np.nanargmax(off)) if np.isfinite(off).any() else 0
    if not off[worst] <= UNIT_LENGTH:
        raise RecordingError(
            f"{recording.source}: the quaternion {' '.join(names)} has length"
            f" {length[worst]:.4g} at sample {worst}; a rotation has length 1",
            cure=Cure("normalise it where it is logged, or check that the columns are quaternions"),
            file=recording.source,
            value=float(length[worst]),
            expected=1.0,
        )
    notes = []
    if off[worst] > 1e-4:
        notes.append(f"quaternions were normalised (length off by up to {off[worst]:.2g})")
    return quaternion / length[:, None], notes


def refuse_units(recording: Recording, f: Array, g: float) -> None:
    """Refuse a specific force (N, 3) whose mean is not of the size g [m/s^2] of gravity."""
    size = float(np.linalg.norm(f.mean(axis=0)))  # motion that stays in place has no mean
    if abs(size - g) <= RULES.gravity * g:
        return
    if size < 0.5:
        what = "gravity is taken out"
        cure = "log what the accelerometer measures, gravity included"
    elif abs(size - 1.0) < RULES.gravity:
        what = "they are in g"
        cure = "multiply them by 9.81"
    else:
        what = "they have another unit, or the robot falls"
        cure = "log them in m/s^2"
    raise make_sensor_error(
        recording,
        f"has imu_ax .. imu_az of {size:.3g} m/s^2 in the mean, where gravity is {g:.3g}: {what}",
        cure,
    )


def refuse_force(recording: Recording, feet: Feet, f: Array) -> None:
    """Refuse a specific force that does not carry the robot while it stands upright."""
    mean = f[feet.find_stance()].mean(axis=0)
    mean /= np.linalg.norm(mean)
    if mean[2] >= np.cos(RULES.upright):
        return
    k = int(np.argmax(np.abs(mean)))
    axis = f"{'-' if mean[k] < 0 else '+'}{'xyz'[k]}"
    what, cure = (
        ("the other sign", "turn the sign")
        if axis == "-z"
        else ("other axes", "turn them into axes of the base, or name the sensor's frame imu")
    )
    raise make_sensor_error(
        recording,
        f"has imu_ax .. imu_az of {what}: while the robot stands they point along {axis} of its"
        " base, where an accelerometer at rest shows 9.81 m/s^2 upwards",
        cure,
    )


def refuse_turn(
    recording: Recording, feet: Feet, R: Array, inverse: Array, w: Array, f: Array
) -> None:
    """Refuse orientations in which gravity is not vertical, and inverse ones."""
    up = np.einsum("sij,sj->si", R, f)[feet.find_stance()].mean(axis=0)
    angle = float(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1.0, 1.0)))
    if angle > RULES.upright / 3.0:
        raise make_sensor_error(
            recording,
            f"has imu_qx .. imu_qw in which gravity is {np.rad2deg(angle):.0f} deg off the"
            " vertical",
            FORWARD,
        )
    off_rates = [float(np.mean((w - find_spin(x, recording.t)) ** 2)) for x in (R, inverse)]
    if off_rates[1] < RULES.share * off_rates[0]:
        raise make_sensor_error(recording, f"has imu_qx .. imu_qw that are {INVERSE}", FORWARD)


def refuse_rates(recording: Recording, feet: Feet, w: Array, f: Array, R: Array | None) -> None:
    """Refuse rates that orientation, feet or gravity contradict, and agree with if read otherwise.

    Without orientations, two feet that stand do not part, and else gravity turns against the base.
    """
    off: Callable[[Array], float]
    if R is not None:
        what = "the quaternion"
        off = partial(_measure_distance, find_spin(R, recording.t))
    elif (feet.stands.sum(axis=0) > 1).sum() > recording.rate:
        what = "the feet that stand"
        off = feet.slip
    else:
        what = "gravity"
        off = partial(_measure_turn_of_gravity, feet, f, recording.rate)
    best = RULES.share * off(w)
    reading = ""
    for M, name in _list_readings():
        left = off(w @ M.T)
        if left < best:
            best = left
            reading = name
    if reading:
        raise make_sensor_error(
            recording,
            f"has imu_wx .. imu_wz that are {reading}: so read, they agree with {what}",
            "log them in rad/s, in axes of the sensor, or name its frame imu in the description",
        )


def _measure_distance(wanted: Array, w: Array) -> float:
    return float(np.mean((w - wanted) ** 2))


def _measure_turn_of_gravity(feet: Feet, f: Array, rate: float, w: Array) -> float:
    """Return the mean square of `du/dt + w x u`, of the vertical u in axes of the base."""
    v, count = feet.base_velocity(w)
    known = np.flatnonzero(count > 0)
    if known.size > rate:
        v = np.stack([np.interp(np.arange(len(v)), known, x) for x in v[known].T], axis=1)
        f = f - np.gradient(v, 1.0 / rate, axis=0)
    u = select_slow_part(f, RULES.turn, rate)
    slow = select_slow_part(w, RULES.turn, rate)
    return float(np.mean((np.gradient(u, 1.0 / rate, axis=0) + np.cross(slow, u)) ** 2))


def refuse_heading(
    recording: Recording, feet: Feet, R: Array, f: Array, w: Array, v: Array, gravity: Array
) -> None:
    """Refuse a sensor that is turned about the vertical, by how feet say that the base moves."""

    def off(own: Array, turned: Array, moved: Array) -> float:
        stands = feet.stands.any(axis=0)
        by_feet = np.einsum("sij,sj->si", turned, feet.base_velocity(own)[0])
        return float(np.mean((by_feet - moved)[stands] ** 2)) if stands.any() else 0.0

    best = RULES.share * off(w, R, v)
    for quarters in (1, 2, 3):
        M = rotation_z(0.5 * np.pi * quarters)
        turned = R @ M.T
        moved, _ = estimate_base_velocity(turned, f @ M.T, feet, w @ M.T, recording.rate, gravity)
        if off(w @ M.T, turned, moved) < best:
            raise make_sensor_error(
                recording,
                f"has an inertial sensor whose axes are turned by {90 * quarters} deg about the"
                " vertical: so read, its accelerations agree with the feet that stand",
                "turn them into axes of the base, or name its frame imu in the description",
            )


def find_spin(R: Array, t: Array) -> Array:
    """Return the angular velocity (N, 3), in their own axes, of rotations (N, 3, 3)."""
    spin = np.einsum("sji,sjk->sik", R, np.gradient(R, t, axis=0))
    return np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)


def _list_readings() -> list[tuple[Array, str]]:
    """Return other readings of a vector (3, 3), with what they are called."""
    found = [(np.deg2rad(1.0) * np.eye(3), "in deg/s")]
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            M = np.zeros((3, 3))
            M[range(3), order] = signs
            axes = ", ".join(
                f"{'-' if s < 0 else ''}{'xyz'[k]}" for s, k in zip(signs, order, strict=True)
            )
            if not np.array_equal(M, np.eye(3)):
                found.append((M, f"in other axes (its {axes} are x, y, z of the base)"))
    return found


def make_sensor_error(recording: Recording, what: str, cure: str) -> RecordingError:
    """Return the error of a recording whose sensor is wrong."""
    return RecordingError(f"{recording.source} {what}", cure=Cure(cure), file=recording.source)
