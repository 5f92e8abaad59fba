"""The virtual robot of the reproduction, its motions and what it logs.

The recordings of the paper are not public. The virtual robot differs from CAD as Table 2 suggests:
rows 8 and 22 of its robot column are 0.46 and 0.45 kg m below CAD, which a wrist lighter by 1.1 kg
explains. Friction and smoothness of the motion are such that the errors of joint 1 match
Table 3.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt import DriveSet, LinkInertia, Recording, RobotModel, simulate_recording
from asbuilt.arrays import Array
from asbuilt.excitation import (
    Concatenated,
    Motion,
    MotionBounds,
    PointToPointMotion,
    QuinticMotion,
    SplineMotion,
)
from asbuilt.experiment import SensorNoise

SEED = 2015
RATE = 1000.0
WRIST = (4, 5, 6)
"""Links 5, 6 and 7, counted from 0."""
WRIST_SHARE = 0.85
"""Mass and inertia of the wrist in multiples of CAD."""
COULOMB = (0.4, 0.9, 0.3, 0.55, 0.2, 0.2, 0.1)
"""Coulomb friction of each joint [N m]."""
SENSORS = SensorNoise(
    encoder_counts=2.0**16,
    torque_noise=(0.18, 0.18, 0.11, 0.11, 0.11, 0.04, 0.04),
    torque_bias=(0.06, 0.05, -0.01, 0.02, -0.01, -0.01, 0.0),
    torque_resolution=(0.02, 0.02, 0.01, 0.01, 0.01, 0.004, 0.004),
)
DIFFERENCES = (
    f"a wrist (links 5 to 7) of {WRIST_SHARE:.0%} of its mass in CAD",
    "Coulomb and viscous friction in every joint",
    "encoder quantisation, noise, bias and resolution of the torque sensors",
)
"""How the virtual robot differs from its CAD model."""

POSES = np.array([0.8, 0.4, 0.6, 0.9, 0.8, 0.8, 0.8])
"""Position range of each joint in multiples of its limits."""
SPEED = 0.9
SMOOTHNESS = 0.6
"""Largest velocity in multiples of the limits; acceleration likewise, times the second."""


def record_virtual_robot(model: RobotModel) -> tuple[Recording, Recording, Motion]:
    """Record the virtual robot of a CAD model on the motions of the paper.

    Returns the spline and point-to-point motion of section 3.2.1, the point-to-point motion of
    section 4, and the latter as it was commanded.
    """
    robot = _lighten_wrist(model)
    rng = np.random.default_rng(SEED)
    bounds = MotionBounds.assumed(model, SPEED)
    bounds = replace(
        bounds,
        lower=POSES * bounds.lower,
        upper=POSES * bounds.upper,
        acceleration=SMOOTHNESS * bounds.acceleration,
    )
    training = _make_training_motion(bounds, rng)
    test = PointToPointMotion.within(
        _draw_random_poses(bounds, rng, 8),
        velocity=bounds.velocity,
        acceleration=bounds.acceleration,
        dwell=0.25,
    )
    # Viscous friction of every joint [N m s/rad].
    values = np.column_stack([np.full(model.n_joints, 0.05), COULOMB]).ravel()
    logs = [
        simulate_recording(
            robot,
            motion,
            rate=RATE,
            drive=DriveSet.parse("viscous,coulomb"),
            drive_values=values,
            noise=SENSORS,
            rng=SEED + k,
        )
        for k, motion in enumerate((training, test))
    ]
    return logs[0], logs[1], test


def make_simulation_motion(model: RobotModel) -> Motion:
    """Return quintic motion that moves every joint, as in section 3.1.1."""
    bounds = MotionBounds.assumed(model, 0.8)
    return _make_quintic(bounds, _draw_random_poses(bounds, np.random.default_rng(SEED), 12))


def _lighten_wrist(model: RobotModel) -> RobotModel:
    links = list(model.links)
    for k in WRIST:
        links[k] = replace(
            links[k],
            inertia=LinkInertia.from_pseudo_inertia(WRIST_SHARE * links[k].inertia.pseudo_inertia),
            parts=(),
        )
    return replace(model, links=tuple(links))


def _make_training_motion(bounds: MotionBounds, rng: np.random.Generator) -> Motion:
    """Return spline and point-to-point motion of about the paper's 53 s."""
    spline = SplineMotion.within(
        _draw_random_poses(bounds, rng, 14),
        velocity=bounds.velocity,
        acceleration=bounds.acceleration,
    )
    poses = _draw_random_poses(bounds, rng, 12)
    poses[0] = spline.end
    return Concatenated([spline, _make_quintic(bounds, poses)])


def _make_quintic(bounds: MotionBounds, poses: Array) -> QuinticMotion:
    return QuinticMotion.within(poses, velocity=bounds.velocity, acceleration=bounds.acceleration)


def _draw_random_poses(bounds: MotionBounds, rng: np.random.Generator, count: int) -> Array:
    return rng.uniform(bounds.lower, bounds.upper, size=(count, len(bounds.lower)))
