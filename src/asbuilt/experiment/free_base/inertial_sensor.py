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
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import rotation_z
from asbuilt.errors import DescriptionError, RecordingError
from asbuilt.experiment.free_base.feet import Feet, find_better_reading
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

# How a sensor is combined with feet, and when it is read wrongly: own choices, tested on a virtual
# Go2 and Solo12.

TILT = 0.1
"""Frequency [Hz] below which gravity says how the base is tilted, above it the rates: a robot
that walks comes back within 10 s, or its feet say by how much it does not."""
DRIFT = 0.2
"""Frequency [Hz] below which feet say how fast the base moves, above it the accelerometer."""
UPDATES = 5
"""Corrections of the tilt, each of which is right to first order."""
TURN = 1.0
"""Frequency [Hz] below which gravity turns against the base as its rates say."""
OFF_GRAVITY = 0.25
"""Part by which the mean specific force may differ from gravity."""
UPRIGHT = np.deg2rad(60.0)
"""Largest mean angle between gravity and where it is expected."""


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
    logged = [known[name] for name in (*ANGULAR, *FORCE, *QUATERNION) if name in known]
    if not (np.isfinite(logged).all() and np.all(np.diff(recording.t) > 0.0)):
        raise make_sensor_error(
            recording,
            "has an inertial sensor with missing values, or a clock that does not advance, so that"
            " it cannot be integrated",
            "log every sample, or give the parts without gaps as separate recordings",
        )
    refuse_units(recording, f, float(np.linalg.norm(model.gravity)))
    places = {*model.link_names, *(frame.name for frame in model.frames)}
    sensor = sensor or next((name for name in PLACES if name in places), model.link_names[5])
    placement = place_on_base(recording.source, model, sensor, "imu_frame")
    w = w @ placement[:3, :3].T
    f = f @ placement[:3, :3].T
    feet = Feet.of(recording, model)
    refuse_force(recording, feet, f)
    R = None
    if set(QUATERNION) <= known.keys():
        turned = _read_rotations(recording)
        R, inverse = (x @ placement[:3, :3].T for x in (turned, np.swapaxes(turned, 1, 2)))
        refuse_turn(recording, feet, R, inverse, w, f)
    refuse_rates(recording, feet, w, f, R)
    arm = placement[:3, 3]
    alpha = np.gradient(w, recording.t, axis=0)
    f = f - np.cross(alpha, arm) - np.cross(w, np.cross(w, arm))
    if R is None:
        R = _level(recording, _integrate_turn(w, f, recording.t), f, feet, w)
    v, offset = estimate_base_velocity(recording, R, f, feet, w, model.gravity)
    refuse_heading(recording, feet, R, f, w, v, model.gravity)
    columns = _make_base_columns(R, v, w, alpha, f - offset, model.gravity, recording.t)
    where = sensor.rpartition("/")[2]
    note = f"the motion of the base is from the inertial sensor at {where} and the feet that stand"
    return replace(recording, extra=dict(known) | columns, notes=(*recording.notes, note))


def estimate_base_velocity(
    recording: Recording, R: Array, f: Array, feet: Feet, w: Array, gravity: Array
) -> tuple[Array, Array]:
    """Return the velocity of the base (N, 3) in world axes, and the offset of the sensor (3,).

    The velocity is the integral of the accelerometer, but for what it drifts by, which feet that
    stand say: `v = integral (R (f - b) + g) + v0`, and slow deviations from that.
    """
    t = recording.t
    acceleration = np.einsum("sij,sj->si", R, f) + gravity
    fallen = cumulative_trapezoid(acceleration, t, axis=0, initial=0)
    own, count = feet.base_velocity(w)
    known = np.flatnonzero(count > 0)
    if known.size < recording.rate:
        # It hardly touches: the drift is not known, and no velocity enters.
        return fallen, np.zeros(3)
    off = (fallen - np.einsum("sij,sj->si", R, own))[known]
    turned = cumulative_trapezoid(R, t, axis=0, initial=0)
    start = np.broadcast_to(np.eye(3), (known.size, 3, 3))
    columns = np.concatenate([turned[known], start], axis=2)
    fit = np.linalg.lstsq(columns.reshape(-1, 6), off.ravel(), rcond=None)[0]
    left = off - columns @ fit
    left = np.stack([np.interp(t, t[known], x) for x in left.T], axis=1)
    steady = turned @ fit[:3] + fit[3:]
    return np.asarray(fallen - steady - select_slow_part(left, DRIFT, recording.rate)), fit[:3]


def select_slow_part(x: Array, frequency: float, rate: float) -> Array:
    """Return x (N, m) below a frequency, by a Gaussian window that mirrors the ends.

    A recursive filter extends them so that it passes through the first and last sample, which are
    as noisy as any.
    """
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415 - light start

    width = rate / (2.0 * np.pi * frequency)
    return np.asarray(gaussian_filter1d(x, width, axis=0, mode="reflect"))


def _level(recording: Recording, R: Array, f: Array, feet: Feet, w: Array) -> Array:
    """Return rotations (N, 3, 3) whose slow tilt agrees with gravity."""
    own, count = feet.base_velocity(w)
    for _ in range(UPDATES):
        moved = np.einsum("sij,sj->si", R, own)
        moved[count == 0] = 0.0
        force = np.einsum("sij,sj->si", R, f) - np.gradient(moved, recording.t, axis=0)
        up = select_slow_part(force, TILT, recording.rate)
        up /= np.linalg.norm(up, axis=1)[:, None]
        R = Rotation.from_rotvec(np.cross(up, [0.0, 0.0, 1.0])).as_matrix() @ R
    return R


def _integrate_turn(w: Array, f: Array, t: Array) -> Array:
    """Return rotations (N, 3, 3) that begin upright by f and turn by w (N, 3) in their own axes."""
    start = Rotation.align_vectors([[0.0, 0.0, 1.0]], f[:50].mean(axis=0)[None])[0].as_matrix()
    steps = Rotation.from_rotvec(0.5 * np.diff(t)[:, None] * (w[1:] + w[:-1])).as_matrix()
    found = np.empty((len(w), 3, 3))
    found[0] = start
    for k, step in enumerate(steps):
        found[k + 1] = found[k] @ step
    return np.asarray(Rotation.from_matrix(found).as_matrix())


def _make_base_columns(
    R: Array, v: Array, w: Array, alpha: Array, f: Array, gravity: Array, t: Array
) -> dict[str, Array]:
    """Return the columns of a base with velocities v (N, 3) in world axes, w in its own.

    `base_a` is the rate of change of the velocity in base axes, which is `R^T a - w x R^T v`.
    """
    place = cumulative_trapezoid(v, t, axis=0, initial=0)
    own = np.einsum("sji,sj->si", R, v)
    a = f + np.einsum("sji,j->si", R, gravity) - np.cross(w, own)
    turn = Rotation.from_matrix(R).as_quat()
    groups = {"base_": place, "base_v": own, "base_w": w, "base_a": a, "base_alpha": alpha}
    found = {
        f"{group}{axis}": values[:, k]
        for group, values in groups.items()
        for k, axis in enumerate("xyz")
    }
    return found | {f"base_q{axis}": turn[:, k] for k, axis in enumerate("xyzw")}


def _read_rotations(recording: Recording) -> Array:
    """Return the rotations (N, 3, 3) of the logged quaternion; refuses one of another length."""
    quaternion = np.stack([recording.extra[name] for name in QUATERNION], axis=1)
    return np.asarray(
        Rotation.from_quat(normalise_quaternions(recording, quaternion, QUATERNION)[0]).as_matrix()
    )


def place_on_base(source: str, model: RobotModel, frame: str, field: str) -> Array:
    """Return the placement (4, 4) of a frame on the base; refuses one that is not fixed to it.

    `field` of a recording sheet may name another.
    """
    base = model.n_floating - 1
    try:
        link, placement = model.placed(frame.rpartition("/")[2])
    except DescriptionError:
        link = -1
        placement = np.eye(4)
    if link != base:
        fixed = [frame.name for frame in model.frames if frame.link == base]
        listed = ", ".join([model.link_names[base], *fixed])
        raise RecordingError(
            f"{source}: the frame {frame!r} is not fixed to the base of {model.name}; its base has"
            f" {listed}",
            cure=Cure(
                "say which of them it is in a recording sheet, or add it to the description:"
                f' {field} = "{model.link_names[base]}"'
            ),
            file=source,
            value=frame,
            available=[model.link_names[base], *fixed],
        )
    return placement


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
    if abs(size - g) <= OFF_GRAVITY * g:
        return
    if size < 0.5:
        what = "gravity is taken out"
        cure = "log what the accelerometer measures, gravity included"
    elif abs(size - 1.0) < OFF_GRAVITY:
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
    if mean[2] >= np.cos(UPRIGHT):
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
    if angle > UPRIGHT / 3.0:
        raise make_sensor_error(
            recording,
            f"has imu_qx .. imu_qw in which gravity is {np.rad2deg(angle):.0f} deg off the"
            " vertical",
            FORWARD,
        )

    def off(turned: Array) -> float:
        return float(np.mean((w - find_spin(turned, recording.t)) ** 2))

    if find_better_reading(off, R, [(INVERSE, inverse)]):
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
        off = partial(_measure_turn_of_gravity, recording, feet, f)
    reading = find_better_reading(off, w, ((name, w @ M.T) for M, name in _list_readings()))
    if reading is not None:
        raise make_sensor_error(
            recording,
            f"has imu_wx .. imu_wz that are {reading}: so read, they agree with {what}",
            "log them in rad/s, in axes of the sensor, or name its frame imu in the description",
        )


def _measure_distance(wanted: Array, w: Array) -> float:
    return float(np.mean((w - wanted) ** 2))


def _measure_turn_of_gravity(recording: Recording, feet: Feet, f: Array, w: Array) -> float:
    """Return the mean square of `du/dt + w x u`, of the vertical u in axes of the base."""
    v, count = feet.base_velocity(w)
    known = np.flatnonzero(count > 0)
    t = recording.t
    if known.size > recording.rate:
        v = np.stack([np.interp(t, t[known], x) for x in v[known].T], axis=1)
        f = f - np.gradient(v, t, axis=0)
    u = select_slow_part(f, TURN, recording.rate)
    slow = select_slow_part(w, TURN, recording.rate)
    return float(np.mean((np.gradient(u, t, axis=0) + np.cross(slow, u)) ** 2))


def refuse_heading(
    recording: Recording, feet: Feet, R: Array, f: Array, w: Array, v: Array, gravity: Array
) -> None:
    """Refuse a sensor that is turned about the vertical, by how feet say that the base moves."""

    def off(reading: tuple[Array, Array, Array]) -> float:
        own, turned, moved = reading
        stands = feet.stands.any(axis=0)
        by_feet = np.einsum("sij,sj->si", turned, feet.base_velocity(own)[0])
        return float(np.mean((by_feet - moved)[stands] ** 2)) if stands.any() else 0.0

    def turn(quarters: int) -> tuple[Array, Array, Array]:
        M = rotation_z(0.5 * np.pi * quarters)
        own = w @ M.T
        turned = R @ M.T
        moved, _ = estimate_base_velocity(recording, turned, f @ M.T, feet, own, gravity)
        return own, turned, moved

    quarters = find_better_reading(off, (w, R, v), ((k, turn(k)) for k in (1, 2, 3)))
    if quarters is not None:
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
