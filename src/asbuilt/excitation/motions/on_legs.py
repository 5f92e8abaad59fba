"""Motions that a robot with a floating base can make about a posture: on its feet and in the air.

They are states at which a regressor is evaluated to tell what such a motion would determine, and no
commands: nobody asks whether the robot keeps its balance. Feet that stand are held where they are
by inverse kinematics; in the air the base moves as momentum demands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import inverse_dynamics, link_poses, mass_matrix
from asbuilt.dynamics.reactions import contact_jacobians
from asbuilt.excitation.limits import MotionBounds

# Sizes of the motions: own choices, what legs of every size do without special skill.
#
# Lengths are in units of the height h of the base above the feet, so that a small robot makes small
# motions.

LEG_MOTION_SECONDS = 8.0
LEG_MOTION_RATE = 25.0
# Frequencies of the base [Hz]: gravity shows in the slow one, inertia in the fast one
LEG_MOTION_SLOW = (0.31, 0.97)
LEG_MOTION_FAST = (0.53, 1.61)  # Frequencies of limbs that carry nothing [Hz]
LEG_MOTION_HEIGHT = 0.15  # Half the range of a squat [h]
LEG_MOTION_SWAY = 0.08  # Half the range of a sway, so that the weight stays between the feet [h]
LEG_MOTION_TURN = 0.2  # Half the range of a turn of the base [rad]
LEG_MOTION_SWING = 0.5  # Half the range of a joint that swings [rad]
LEG_MOTION_LIFT = 0.2  # Height at which a lifted foot is held [h]
# Part of the time that hops spend in the air, less what a low-pass spreads at touch-down
LEG_MOTION_AIRBORNE = 0.2
LEG_MOTION_HALVINGS = 3  # How often a motion out of reach is made half as large
LEG_MOTION_STEPS = 12
LEG_MOTION_REACHED = 1e-3  # Gap of a foot that counts as closed [h]


@dataclass(frozen=True, slots=True, eq=False)
class LegMotion:
    """Hold a motion: its name, states (N, n), which contacts are closed, and its part of time."""

    name: str
    q: Array
    qd: Array
    qdd: Array
    closed: Mask
    share: float = 1.0


def leg_motions(model: RobotModel, posture: Array) -> Iterator[LegMotion]:
    """Yield the motions that a robot can make about a posture q (n,), the gentlest first.

    The base of the robot is free, with the six coordinates of `structure.free_base` first.
    """
    t = np.arange(0.0, LEG_MOTION_SECONDS, 1.0 / LEG_MOTION_RATE)
    yield from _move_on_feet(model, posture, t)
    yield _move_in_the_air(model, posture, t)


def _move_on_feet(model: RobotModel, posture: Array, t: Array) -> Iterator[LegMotion]:
    feet = len(model.contacts)
    if not feet:
        return
    h = _measure_height(model, posture)
    aside = LEG_MOTION_SWAY * h
    down = LEG_MOTION_HEIGHT * h
    turn = LEG_MOTION_TURN
    for name, size in (
        ("squats", [0, 0, down, 0, 0, 0]),
        ("swaying on standing feet", [aside, aside, 0, 0, 0, 0]),
        ("leaning the trunk on standing feet", [0, 0, 0, 0, turn, turn]),
        ("twisting the trunk on standing feet", [0, 0, 0, turn, 0, 0]),
        ("squatting, leaning and twisting at once", [aside, aside, down, turn, turn, turn]),
    ):
        base = np.array(size) * _build_waves(t, 6, LEG_MOTION_SLOW)
        motion = _move_base(model, posture, name, base, np.ones(feet, dtype=np.bool_))
        if motion is not None:
            yield motion
    legs = [_find_joints_above(model, contact.frame) for contact in model.contacts]
    lifts = [_lift_foot(model, posture, t, k, legs) for k in range(feet) if feet > 1]
    lifted = [motion for motion in lifts if motion is not None]
    if lifted:
        yield LegMotion(
            "lifting one foot after the other and swinging its leg",
            q=np.concatenate([motion.q for motion in lifted]),
            qd=np.concatenate([motion.qd for motion in lifted]),
            qdd=np.concatenate([motion.qdd for motion in lifted]),
            closed=np.concatenate([motion.closed for motion in lifted]),
        )
    free = sorted(set(range(6, model.n_joints)).difference(*legs))
    if free:
        name = "standing and swinging all joints that carry no foot"
        still = np.zeros((t.size, 6))
        motion = _move_base(model, posture, name, still, np.ones(feet, dtype=np.bool_), free)
        if motion is not None:
            yield motion


def _lift_foot(
    model: RobotModel, posture: Array, t: Array, k: int, legs: list[set[int]]
) -> LegMotion | None:
    """Return the motion of the leg of contact k, the others on the ground, if they reach."""
    stands = np.arange(len(legs)) != k
    own = sorted(legs[k].difference(*(legs[j] for j in np.flatnonzero(stands))))
    return _move_base(model, posture, "", np.zeros((t.size, 6)), stands, own)


def _move_base(
    model: RobotModel,
    posture: Array,
    name: str,
    base: Array,
    stands: Mask,
    swinging: list[int] | None = None,
) -> LegMotion | None:
    """Return the motion of a base (N, 6) on feet that stand, if these reach."""
    rest = posture
    if not stands.all():
        lifted = np.asarray(
            LEG_MOTION_LIFT * _measure_height(model, posture) * ~stands, dtype=np.float64
        )
        rest, off = _put_on_ground(model, posture[None], posture, stands | True, lifted)
        rest = rest[0] if off else posture
    for k in range(LEG_MOTION_HALVINGS + 1):
        q = rest + np.zeros((len(base), 1))
        q[:, :6] += 0.5**k * base
        if swinging:
            t = np.arange(len(base)) / LEG_MOTION_RATE
            waves = _build_waves(t, len(swinging), LEG_MOTION_FAST)
            q[:, swinging] += 0.5**k * waves * _measure_room(model, rest)[swinging]
        q, reached = _put_on_ground(model, q, posture, stands)
        if reached:
            rates = np.gradient(q, 1.0 / LEG_MOTION_RATE, axis=0)
            second = np.gradient(rates, 1.0 / LEG_MOTION_RATE, axis=0)
            return LegMotion(name, q, rates, second, np.tile(stands, (len(q), 1)))
    return None


def _move_in_the_air(model: RobotModel, posture: Array, t: Array) -> LegMotion:
    """Return the motion of all joints where nothing touches the robot, with its momentum."""
    n = model.n_joints
    q = np.tile(posture, (t.size, 1))
    q[:, 6:] += _build_waves(t, n - 6, LEG_MOTION_FAST) * _measure_room(model, posture)[6:]
    qd = np.gradient(q, 1.0 / LEG_MOTION_RATE, axis=0)
    qdd = np.gradient(qd, 1.0 / LEG_MOTION_RATE, axis=0)
    M = mass_matrix(model, q)
    qd[:, :6] = -_solve(M[:, :6, :6], np.einsum("sij,sj->si", M[:, :6, 6:], qd[:, 6:]))
    qdd[:, :6] = 0.0
    qdd[:, :6] = -_solve(M[:, :6, :6], inverse_dynamics(model, q, qd, qdd)[:, :6])
    feet = len(model.contacts)
    name = "hops with legs that swing in the air" if feet else "moving all joints at once"
    share = LEG_MOTION_AIRBORNE if feet else 1.0
    return LegMotion(name, q, qd, qdd, np.zeros((t.size, feet), dtype=np.bool_), share)


def _solve(A: Array, b: Array) -> Array:
    return np.asarray(np.linalg.solve(A, b[:, :, None])[:, :, 0])


def _build_waves(t: Array, n: int, frequencies: tuple[float, float]) -> Array:
    """Return sums of two sines (N, n) of size 1, of other phases in each column."""
    phase = 2.0 * np.pi * np.arange(n) * (np.sqrt(5.0) - 1.0) / 2.0  # golden: no two alike
    slow, fast = (2.0 * np.pi * f * t[:, None] for f in frequencies)
    return np.asarray(0.6 * np.sin(slow + phase) + 0.4 * np.sin(fast + 2.0 * phase))


def _measure_room(model: RobotModel, posture: Array) -> Array:
    """Return how far joints (n,) can swing to both sides of a posture."""
    bounds = MotionBounds.of(model)
    margin = np.minimum(bounds.upper - posture, posture - bounds.lower)
    return np.asarray(np.clip(margin, 0.0, LEG_MOTION_SWING))


def _find_joints_above(model: RobotModel, frame: str) -> set[int]:
    """Return the joints that move a frame and are no joints of the base."""
    J = contact_jacobians(
        replace(model, contacts=tuple(c for c in model.contacts if c.frame == frame)),
        np.linspace(0.3, 0.7, model.n_joints)[None],
    )[0][0]
    return {int(k) for k in np.flatnonzero(np.abs(J).max(axis=0) > 1e-9) if k >= 6}


def _place_contacts(model: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return place (N, n_contacts, 3) and rotation (N, n_contacts, 3, 3) of each contact."""
    poses = link_poses(model, q)
    places = (model.placed(contact.frame) for contact in model.contacts)
    T = np.stack([poses[:, link] @ place for link, place in places], axis=1)
    return T[..., :3, 3], T[..., :3, :3]


def _measure_height(model: RobotModel, posture: Array) -> float:
    """Return the height of the base above its lowest contact [m]."""
    lowest = float(_place_contacts(model, posture[None])[0][0, :, 2].min())
    return max(float(posture[2]) - lowest, 0.05)


def _put_on_ground(
    model: RobotModel, q: Array, posture: Array, stands: Mask, lift: Array | float = 0.0
) -> tuple[Array, bool]:
    """Return positions (N, n) with the feet that stand where they are in a posture, but for `lift`.

    Base and joints that move no such foot stay as they are. Also whether the feet get there, within
    the limits of the joints.
    """
    points = replace(model, contacts=tuple(replace(c, radius=0.0) for c in model.contacts))
    goal, turn = _place_contacts(points, posture[None])
    goal = goal + np.outer(np.broadcast_to(lift, len(points.contacts)), [0.0, 0.0, 1.0])
    q = q.copy()
    off = np.inf
    height = _measure_height(model, posture)
    for _ in range(LEG_MOTION_STEPS):
        at, R = _place_contacts(points, q)
        jacobians = contact_jacobians(points, q)
        gaps = []
        rows = []
        for k in np.flatnonzero(stands):
            gap = goal[:, k] - at[:, k]
            if points.contacts[k].flat:
                gap = np.hstack([gap, _find_rotation(turn[:, k] @ np.swapaxes(R[:, k], 1, 2))])
            gaps.append(gap)
            rows.append(jacobians[k][:, :, 6:])
        gap = np.hstack(gaps)
        off = float(np.abs(gap).max())
        if off < 1e-2 * LEG_MOTION_REACHED * height:
            break
        step = np.linalg.pinv(np.concatenate(rows, axis=1), rcond=1e-3)
        q[:, 6:] += np.clip(np.einsum("sij,sj->si", step, gap), -0.3, 0.3)
    bounds = MotionBounds.of(model)
    inside = bool(np.all((q >= bounds.lower)[:, 6:] & (q <= bounds.upper)[:, 6:]))
    return q, inside and off < LEG_MOTION_REACHED * height


def _find_rotation(R: Array) -> Array:
    """Return the small rotation vector (N, 3) of rotations (N, 3, 3)."""
    return 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
