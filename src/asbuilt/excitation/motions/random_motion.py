"""Random motions within the limits of a robot: a sane excitation where none was designed."""

from __future__ import annotations

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kinematics import draw_postures_within, find_first_posture
from asbuilt.errors import MotionError
from asbuilt.excitation.limits import MotionBounds, check_motion
from asbuilt.excitation.motions.fourier import FourierMotion
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.point_to_point import PointToPointMotion

Seed = np.random.Generator | int | None

SHRINKAGE = 0.85
"""By what factor amplitudes or accelerations are reduced each time the torque limit is exceeded."""

ATTEMPTS = 40
"""How often that is tried."""

CHECKED_RATE = 100.0
"""Rate at which torque and loops of a random motion are checked [Hz]."""


def random_fourier(
    model: RobotModel,
    rng: Seed = None,
    *,
    duration: float = 20.0,
    n_harmonics: int = 5,
    periods: int = 1,
    fraction: float = 0.9,
) -> FourierMotion:
    """Return a random Fourier motion that uses `fraction` of a limit of each joint.

    It is scaled until each joint reaches its position, velocity or acceleration limit.

    Coefficients are normal, alike for all harmonics; each joint's mean position is drawn where its
    amplitude allows. Limits that the description does not give come from
    `MotionBounds.assumed`. Where a torque limit is exceeded all amplitudes shrink. Where loops do
    not close everywhere within the limits, it shrinks towards the posture of the description.

    Raises
    ------
    MotionError
        If the robot cannot hold its weight within the torque limits even at small amplitudes, or
        its loops close nowhere about the posture of the description.
    """
    if n_harmonics < 2 or periods < 1:
        raise MotionError(
            f"a Fourier motion needs at least 2 harmonics and 1 period, got {n_harmonics} and"
            f" {periods}"
        )
    generator = np.random.default_rng(rng)
    bounds = MotionBounds.assumed(model, fraction)
    rows = generator.normal(size=(2 * n_harmonics - 1, model.n_joints))
    rows[0] = 0.0
    shape = FourierMotion(rows, duration / periods, periods)
    low, high = shape.extremes(0)
    scales = [
        (bounds.upper - bounds.lower) / (high - low),
        bounds.velocity / shape.peaks(1),
        bounds.acceleration / shape.peaks(2),
    ]
    scale = np.min([*scales, bounds.jerk / shape.peaks(3)], axis=0)
    place = generator.uniform(size=model.n_joints)
    home = find_first_posture(model)

    def motion(size: float) -> FourierMotion:
        coefficients = size * scale * rows
        free_low = bounds.lower - size * scale * low
        free_high = bounds.upper - size * scale * high
        centre = free_low + place * (free_high - free_low)
        coefficients[0] = centre if home is None else home + size * (centre - home)
        return shape.with_coefficients(coefficients)

    size = 1.0
    for _ in range(ATTEMPTS):
        candidate = motion(size)
        if _closes(model, candidate) and _holds_torque(model, candidate, fraction):
            return candidate
        size *= SHRINKAGE
    raise _make_torque_error(model)


def random_point_to_point(
    model: RobotModel,
    rng: Seed = None,
    n_poses: int = 20,
    *,
    dwell: float = 0.25,
    fraction: float = 0.9,
) -> PointToPointMotion:
    """Return a point-to-point motion through `n_poses` random poses, within the limits.

    It uses `fraction` of them.

    Poses are uniform within the position limits; limits that the description does not give come
    from `MotionBounds.assumed`. Where a torque limit is exceeded the acceleration shrinks.
    Raises MotionError as `random_fourier` does.
    """
    if n_poses < 2:
        raise MotionError(f"a point-to-point motion needs at least 2 poses, got {n_poses}")
    generator = np.random.default_rng(rng)
    bounds = MotionBounds.assumed(model, fraction)
    poses = draw_postures_within(model, bounds.lower, bounds.upper, generator, n_poses)
    home = find_first_posture(model)
    size = 1.0
    for _ in range(ATTEMPTS):
        motion = PointToPointMotion.within(
            poses,
            velocity=np.sqrt(size) * bounds.velocity,
            acceleration=size * bounds.acceleration,
            dwell=dwell,
        )
        if home is not None and not _closes(model, motion):
            # Loops that close at two poses need not close on the way.
            poses = home + SHRINKAGE * (poses - home)
            continue
        if _holds_torque(model, motion, fraction):
            return motion
        size *= SHRINKAGE
        if size < SHRINKAGE ** (ATTEMPTS // 2):
            poses = draw_postures_within(model, bounds.lower, bounds.upper, generator, n_poses)
    raise _make_torque_error(model)


def _closes(model: RobotModel, motion: Motion) -> bool:
    """Return whether the loops of the robot, if it has any, close all along a motion."""
    if model.closure is None:
        return True
    q = motion.derivative(motion.sample_times(CHECKED_RATE), 0)
    return bool(model.closure.postures(q).closed.all())


def _holds_torque(model: RobotModel, motion: Motion, fraction: float) -> bool:
    if not np.any(np.isfinite(MotionBounds.of(model).torque)):
        return True
    worst = check_motion(model, motion, CHECKED_RATE).worst["torque"]
    return worst is None or worst.margin >= 1 - fraction


def _make_torque_error(model: RobotModel) -> MotionError:
    limits = ", ".join(f"{limit:g}" for limit in MotionBounds.of(model).torque)
    if model.closure is not None and not np.any(np.isfinite(MotionBounds.of(model).torque)):
        return MotionError(
            f"{model.name}: no random motion was found along which the loops close; check points of"
            " the loops and the posture of the description"
        )
    return MotionError(
        f"{model.name}: no random motion within the torque limits ({limits}) was found, however"
        " slow; check torque limits, masses and gravity, or raise `fraction`"
    )
