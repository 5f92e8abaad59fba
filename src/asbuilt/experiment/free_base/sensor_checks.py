"""Checks of an inertial sensor: units, sign and axes by gravity, orientation and feet that stand.

Each refuses a reading that the log contradicts, and names one that agrees with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import permutations, product

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.rotation import rotation_z
from asbuilt.errors import RecordingError
from asbuilt.experiment.free_base.feet import (
    RULES,
    Feet,
    estimate_base_velocity,
    select_slow_part,
)
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure

INVERSE = "the inverse of a rotation: so read, it turns as imu_wx .. imu_wz say"
FORWARD = "log the quaternion x y z w that turns axes of the sensor into axes of the world"
UNIT_LENGTH = 0.02
"""Largest deviation of a quaternion's length from 1 that is rounding or drift of an estimator."""


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
