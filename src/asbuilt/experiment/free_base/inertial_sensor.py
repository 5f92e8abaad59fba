"""Base of a robot on legs from an inertial sensor and its feet, where its pose is not logged.

`imu_wx .. imu_wz` [rad/s] and the specific force `imu_ax .. imu_az` [m/s^2] (9.81 upwards at rest)
are in axes of the sensor, as is the quaternion `imu_qx .. imu_qw` that turns them into those of the
world, if there is one. The sensor is at the link or frame `imu` or `imu_link`, or else at the base.

Equations of motion depend on how the base is turned, on its angular velocity and on both
accelerations, not on where it is. Accelerations are those of the sensor; feet that stand still say
how fast the base moves, which takes away what integrals of the sensor drift by (Bloesch et al.,
State estimation for legged robots, RSS 2012, by a filter in place of our zero-phase one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.contact import SAMPLES_AT_ONCE, contact_jacobians
from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure

ANGULAR = ("imu_wx", "imu_wy", "imu_wz")
FORCE = ("imu_ax", "imu_ay", "imu_az")
QUATERNION = ("imu_qx", "imu_qy", "imu_qz", "imu_qw")
PLACES = ("imu", "imu_link")
INVERSE = "the inverse of a rotation: so read, it turns as imu_wx .. imu_wz say"
FORWARD = "log the quaternion x y z w that turns axes of the sensor into those of the world"
UNIT_LENGTH = 0.02
"""Largest deviation of a quaternion's length from 1 that is rounding or drift of an estimator."""


@dataclass(frozen=True, slots=True)
class InertialRules:
    """Say how a sensor is combined with feet, and when it is read wrongly: own choices.

    Tested on a virtual Go2 and Solo12.
    """

    tilt: float = 0.1
    """Frequency [Hz] below which gravity says how the base is tilted, above it the rates: a robot
    that walks comes back within 10 s, or its feet say by how much it does not."""
    drift: float = 0.2
    """Frequency [Hz] below which feet say how fast the base moves, above it the accelerometer."""
    updates: int = 5
    """Corrections of the tilt, each of which is right to first order."""
    turn: float = 1.0
    """Frequency [Hz] below which gravity turns against the base as its rates say."""
    gravity: float = 0.25
    """Part by which the mean specific force may differ from that of gravity."""
    upright: float = np.deg2rad(60.0)
    """Largest mean angle between gravity and where it is expected."""
    share: float = 0.5
    """Part of the squared disagreement that is left by another reading, if that is right."""


RULES = InertialRules()


def with_inertial_base(recording: Recording, model: RobotModel) -> Recording:
    """Return a recording with columns of the base from those of an inertial sensor.

    Nothing changes where the log has a pose of the base, or no sensor.

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
        raise _wrong(
            recording,
            f"has an inertial sensor, but no column {missing[0]!r}",
            f"log {' '.join((*ANGULAR, *FORCE))}, or the pose of the base",
        )
    w, f = (np.stack([known[name] for name in names], axis=1) for names in (ANGULAR, FORCE))
    g = float(np.linalg.norm(model.gravity))
    _refuse_units(recording, f, g)
    placement, where = _placement(recording, model)
    w, f = w @ placement[:3, :3].T, f @ placement[:3, :3].T
    feet = Feet.of(recording, model)
    _refuse_force(recording, feet, f)
    R = None
    if set(QUATERNION) <= known.keys():
        R = _logged(recording) @ placement[:3, :3].T
        _refuse_turn(recording, feet, R, f)
        inverse = np.swapaxes(_logged(recording), 1, 2) @ placement[:3, :3].T
        off = [np.mean((w - _spin(each, recording.t)) ** 2) for each in (R, inverse)]
        if off[1] < RULES.share * off[0]:
            raise _wrong(recording, f"has imu_qx .. imu_qw that are {INVERSE}", FORWARD)
    _refuse_rates(recording, feet, w, f, R)
    arm, dt = placement[:3, 3], 1.0 / recording.rate
    alpha = np.gradient(w, recording.t, axis=0)
    f = f - np.cross(alpha, arm) - np.cross(w, np.cross(w, arm))
    if R is None:
        R = _levelled(_turned(w, f, dt), f, feet, w, recording.rate)
    v, offset = _velocity(R, f, feet, w, recording.rate, model.gravity)
    _refuse_heading(recording, feet, R, f, w, v, model.gravity)
    columns = _base_columns(R, v, w, alpha, f - offset, model.gravity, dt)
    note = f"the base is that of the inertial sensor at {where} and of the feet that stand"
    return replace(recording, extra=dict(known) | columns, notes=(*recording.notes, note))


@dataclass(frozen=True, slots=True, eq=False)
class Feet:
    """Hold how feet move in base axes while the base is held: for each its place and velocity.

    `place` and `velocity` are (n_contacts, N, 3), `stands` (n_contacts, N) where it is closed.
    """

    place: Array
    velocity: Array
    stands: Array

    @classmethod
    def of(cls, recording: Recording, model: RobotModel) -> Feet:
        """Return the feet of a recording of the joints alone; of contact flags those it has."""
        q = np.hstack([np.zeros((recording.n_samples, 6)), recording.q])
        rates = recording.qd
        rates = np.gradient(recording.q, recording.t, axis=0) if rates is None else rates
        shape = (len(model.contacts), recording.n_samples, 3)
        place, velocity = np.zeros(shape), np.zeros(shape)
        for start in range(0, len(q), SAMPLES_AT_ONCE):
            span = slice(start, start + SAMPLES_AT_ONCE)
            for k, J in enumerate(contact_jacobians(model, q[span])):
                velocity[k, span] = np.einsum("sij,sj->si", J[:, :3, 6:], rates[span])
                # At zero, the columns of yaw and pitch are z x place and y x place.
                place[k, span] = np.stack([J[:, 1, 3], -J[:, 0, 3], J[:, 0, 4]], axis=1)
        stands = np.zeros(shape[:2])
        for k, contact in enumerate(model.contacts):
            name = f"contact_{contact.frame}"
            flag = recording.extra.get(name)
            if flag is None and f"{name}_fz" in recording.extra:
                force = np.abs(recording.extra[f"{name}_fz"])
                flag = force > 0.02 * np.nanquantile(force, 0.95)
            if flag is not None:
                stands[k] = np.nan_to_num(flag) > 0.5
        return cls(place, velocity, stands)

    def base_velocity(self, w: Array) -> tuple[Array, Array]:
        """Return the velocity (N, 3) in base axes at which feet stand, and how many do (N,)."""
        each = -self.velocity - np.cross(w, self.place)
        count = self.stands.sum(axis=0)
        total = np.einsum("ks,ksi->si", self.stands, each)
        return total / np.maximum(count, 1.0)[:, None], count

    def slip(self, w: Array) -> float:
        """Return the mean square speed of feet that stand, at the velocity that suits them best."""
        v, count = self.base_velocity(w)
        speed = np.sum((v + self.velocity + np.cross(w, self.place)) ** 2, axis=2)
        several = self.stands * (count > 1)
        capped = np.minimum(speed, np.quantile(speed[several > 0], 0.9) if several.any() else 0.0)
        return float(np.sum(several * capped) / max(several.sum(), 1.0))


def _velocity(
    R: Array, f: Array, feet: Feet, w: Array, rate: float, gravity: Array
) -> tuple[Array, Array]:
    """Return the velocity of the base (N, 3) in world axes, and the offset of the sensor (3,).

    The velocity is the integral of the accelerometer, but for what it drifts by, which feet that
    stand say: `v = integral (R (f - b) + g) + v0`, and slow deviations from that.
    """
    fallen = _integral(np.einsum("sij,sj->si", R, f) + gravity, 1.0 / rate)
    own, count = feet.base_velocity(w)
    known = np.flatnonzero(count > 0)
    if known.size < rate:  # it hardly touches: the drift is not known, and no velocity enters
        return fallen, np.zeros(3)
    off = (fallen - np.einsum("sij,sj->si", R, own))[known]
    turned = _integral(R.reshape(-1, 9), 1.0 / rate).reshape(-1, 3, 3)
    start = np.broadcast_to(np.eye(3), (known.size, 3, 3))
    columns = np.concatenate([turned[known], start], axis=2)
    fit = np.linalg.lstsq(columns.reshape(-1, 6), off.ravel(), rcond=None)[0]
    left = off - columns @ fit
    left = np.stack([np.interp(np.arange(len(f)), known, x) for x in left.T], axis=1)
    steady = turned @ fit[:3] + fit[3:]
    return np.asarray(fallen - steady - _slow_part(left, RULES.drift, rate)), fit[:3]


def _levelled(R: Array, f: Array, feet: Feet, w: Array, rate: float) -> Array:
    """Return rotations (N, 3, 3) whose slow tilt is that of gravity."""
    own, count = feet.base_velocity(w)
    for _ in range(RULES.updates):
        moved = np.einsum("sij,sj->si", R, own)
        moved[count == 0] = 0.0
        force = np.einsum("sij,sj->si", R, f) - np.gradient(moved, 1.0 / rate, axis=0)
        up = _slow_part(force, RULES.tilt, rate)
        up /= np.linalg.norm(up, axis=1)[:, None]
        R = Rotation.from_rotvec(np.cross(up, [0.0, 0.0, 1.0])).as_matrix() @ R
    return R


def _slow_part(x: Array, frequency: float, rate: float) -> Array:
    """Return x (N, m) below a frequency, by a Gaussian window that mirrors the ends.

    A recursive filter extends them so that it passes through the first and last sample, which are
    as noisy as any.
    """
    width = rate / (2.0 * np.pi * frequency)
    return np.asarray(gaussian_filter1d(x, width, axis=0, mode="reflect"))


def _turned(w: Array, f: Array, dt: float) -> Array:
    """Return rotations (N, 3, 3) that begin upright by f and turn by w (N, 3) in their own axes."""
    start = Rotation.align_vectors([[0.0, 0.0, 1.0]], f[:50].mean(axis=0)[None])[0].as_matrix()
    steps = Rotation.from_rotvec(0.5 * dt * (w[1:] + w[:-1])).as_matrix()
    found = np.empty((len(w), 3, 3))
    found[0] = start
    for k, step in enumerate(steps):
        found[k + 1] = found[k] @ step
    return np.asarray(Rotation.from_matrix(found).as_matrix())


def _integral(x: Array, dt: float) -> Array:
    """Return the integral (N, m) from the first sample on, by trapezoids."""
    return np.vstack([np.zeros(x.shape[1]), np.cumsum(0.5 * dt * (x[1:] + x[:-1]), axis=0)])


def _base_columns(
    R: Array, v: Array, w: Array, alpha: Array, f: Array, gravity: Array, dt: float
) -> dict[str, Array]:
    """Return the columns of a base with velocities v (N, 3) in world axes, w in its own.

    `base_a` is the rate of change of the velocity in base axes, which is `R^T a - w x R^T v`.
    """
    place, own = _integral(v, dt), np.einsum("sji,sj->si", R, v)
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


def _logged(recording: Recording) -> Array:
    """Return the rotations (N, 3, 3) of the logged quaternion; refuses one of another length."""
    quaternion = np.stack([recording.extra[name] for name in QUATERNION], axis=1)
    return np.asarray(
        Rotation.from_quat(unit_quaternions(recording, quaternion, QUATERNION)[0]).as_matrix()
    )


def unit_quaternions(
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


def _placement(recording: Recording, model: RobotModel) -> tuple[Array, str]:
    """Return the placement (4, 4) of the sensor in the base, and its name."""
    base = model.n_floating - 1
    for name in PLACES:
        if name in model.link_names or name in {frame.name for frame in model.frames}:
            link, placement = model.placed(name)
            if link != base:
                raise _wrong(
                    recording,
                    f"has an inertial sensor, and {name} of {model.name} is not fixed to its base",
                    "log the sensor of the base, or its pose",
                )
            return placement, name
    return np.eye(4), model.link_names[base]


def _refuse_units(recording: Recording, f: Array, g: float) -> None:
    size = float(np.linalg.norm(f.mean(axis=0)))  # motion that stays in place has no mean
    if abs(size - g) <= RULES.gravity * g:
        return
    if size < 0.5:
        what, cure = "gravity is taken out", "log what the accelerometer measures, gravity included"
    elif abs(size - 1.0) < RULES.gravity:
        what, cure = "they are in g", "multiply them by 9.81"
    else:
        what, cure = "they have another unit, or the robot falls", "log them in m/s^2"
    raise _wrong(
        recording,
        f"has imu_ax .. imu_az of {size:.3g} m/s^2 in the mean, where gravity is {g:.3g}:"
        f" {what}",
        cure,
    )


def _refuse_rates(recording: Recording, feet: Feet, w: Array, f: Array, R: Array | None) -> None:
    """Refuse rates that orientation, feet or gravity contradict, and agree with if read otherwise.

    Without orientations, two feet that stand do not part, and else gravity turns against the base.
    """
    if R is not None:
        turned = _spin(R, recording.t)
        what, off = "the quaternion", lambda w: float(np.mean((w - turned) ** 2))
    elif (feet.stands.sum(axis=0) > 1).sum() > recording.rate:
        what, off = "the feet that stand", feet.slip
    else:
        what, off = "gravity", partial(_turn_of_gravity, feet, f, recording.rate)
    best, reading = RULES.share * off(w), ""
    for M, name in _readings():
        left = off(w @ M.T)
        if left < best:
            best, reading = left, name
    if reading:
        raise _wrong(
            recording,
            f"has imu_wx .. imu_wz that are {reading}: so read, they agree with {what}",
            "log them in rad/s, in axes of the sensor, or name its frame imu in the description",
        )


def _refuse_heading(
    recording: Recording, feet: Feet, R: Array, f: Array, w: Array, v: Array, gravity: Array
) -> None:
    """Refuse a sensor that is turned about the vertical, by how feet say that the base moves."""

    def off(own: Array, turned: Array, moved: Array) -> float:
        stands = feet.stands.any(axis=0)
        by_feet = np.einsum("sij,sj->si", turned, feet.base_velocity(own)[0])
        return float(np.mean((by_feet - moved)[stands] ** 2)) if stands.any() else 0.0

    best = RULES.share * off(w, R, v)
    for quarters in (1, 2, 3):
        M = Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix()
        turned = R @ M.T
        moved, _ = _velocity(turned, f @ M.T, feet, w @ M.T, recording.rate, gravity)
        if off(w @ M.T, turned, moved) < best:
            raise _wrong(
                recording,
                f"has an inertial sensor whose axes are turned by {90 * quarters} deg about the"
                " vertical: so read, its accelerations agree with the feet that stand",
                "turn them into axes of the base, or name its frame imu in the description",
            )


def _spin(R: Array, t: Array) -> Array:
    """Return the angular velocity (N, 3), in their own axes, of rotations (N, 3, 3)."""
    spin = np.einsum("sji,sjk->sik", R, np.gradient(R, t, axis=0))
    return np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)


def _turn_of_gravity(feet: Feet, f: Array, rate: float, w: Array) -> float:
    """Return the mean square of `du/dt + w x u`, of the vertical u in axes of the base."""
    v, count = feet.base_velocity(w)
    known = np.flatnonzero(count > 0)
    if known.size > rate:
        v = np.stack([np.interp(np.arange(len(v)), known, x) for x in v[known].T], axis=1)
        f = f - np.gradient(v, 1.0 / rate, axis=0)
    u, slow = _slow_part(f, RULES.turn, rate), _slow_part(w, RULES.turn, rate)
    return float(np.mean((np.gradient(u, 1.0 / rate, axis=0) + np.cross(slow, u)) ** 2))


def _readings() -> list[tuple[Array, str]]:
    """Return other readings of a vector (3, 3), with what they are called."""
    found = [(np.deg2rad(1.0) * np.eye(3), "in deg/s")]
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            M = np.zeros((3, 3))
            M[range(3), order] = signs
            axes = ", ".join(f"{'-' if s < 0 else ''}{'xyz'[k]}" for s, k in zip(signs, order, strict=True))
            if not np.array_equal(M, np.eye(3)):
                found.append((M, f"in other axes (its {axes} are x, y, z of the base)"))
    return found


def _refuse_force(recording: Recording, feet: Feet, f: Array) -> None:
    """Refuse a specific force that does not carry the robot while it stands upright."""
    standing = feet.stands.any(axis=0) if feet.stands.any() else np.ones(len(f), dtype=np.bool_)
    mean = f[standing].mean(axis=0)
    mean /= np.linalg.norm(mean)
    if mean[2] >= np.cos(RULES.upright):
        return
    k = int(np.argmax(np.abs(mean)))
    axis = f"{'-' if mean[k] < 0 else '+'}{'xyz'[k]}"
    what = "the other sign" if axis == "-z" else "other axes"
    raise _wrong(
        recording,
        f"has imu_ax .. imu_az of {what}: while the robot stands they point along {axis} of its"
        " base, where an accelerometer at rest shows 9.81 m/s^2 upwards",
        "turn the sign"
        if axis == "-z"
        else "turn them into axes of the base, or name the frame of the sensor imu in the"
        " description",
    )


def _refuse_turn(recording: Recording, feet: Feet, R: Array, f: Array) -> None:
    """Refuse orientations in which gravity is not vertical."""
    standing = feet.stands.any(axis=0) if feet.stands.any() else np.ones(len(f), dtype=np.bool_)

    def off(turn: Array) -> float:
        up = np.einsum("sij,sj->si", turn, f)[standing].mean(axis=0)
        return float(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1.0, 1.0)))

    angle = off(R)
    if angle > RULES.upright / 3.0:
        raise _wrong(
            recording,
            f"has imu_qx .. imu_qw in which gravity is {np.rad2deg(angle):.0f} deg off the vertical",
            FORWARD,
        )


def _wrong(recording: Recording, what: str, cure: str) -> RecordingError:
    return RecordingError(f"{recording.source} {what}", cure=Cure(cure), file=recording.source)
