"""Rows of random motion within the joint limits, the motion that a robot may be asked for next."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, observation_matrix
from asbuilt.dynamics.kinematics import draw_postures_within
from asbuilt.experiment.signal.samples import Samples

RANDOM_STATES = 500
RANDOM_RATE = 2.0
"""Largest velocity and acceleration of random motion [rad or m, per s and s^2].

Joints without limits turn through the whole circle or slide by a metre.
"""
RANDOM_SEED = 2015


def build_random_motion_rows(
    model: RobotModel, base: BaseParameters, rates: tuple[Array, Array] | None = None
) -> Array:
    """Return the observation matrix (N n, p) of random motion within limits, always the same.

    Velocities and accelerations are uniform up to `RANDOM_RATE`, or normal with the standard
    deviations `rates`, each (n,).
    """
    rng = np.random.default_rng(RANDOM_SEED)
    q = draw_positions(model, rng)
    qd, qdd = (
        (rng.uniform(-RANDOM_RATE, RANDOM_RATE, q.shape) for _ in range(2))
        if rates is None
        else (deviation * rng.normal(size=q.shape) for deviation in rates)
    )
    return observation_matrix(model, q, qd, qdd, drive=base.drive, columns=base.columns)


def draw_positions(model: RobotModel, rng: np.random.Generator) -> Array:
    """Return positions (N, n), uniform within the limits, at which there are postures."""
    limits = np.array([(joint.limits.lower, joint.limits.upper) for joint in model.joints]).T
    far = np.array([np.pi if joint.is_revolute else 1.0 for joint in model.joints])
    # Joints without limits count as a whole circle, or two metres of travel.
    low, high = np.where(np.isfinite(limits), limits, [-far, far])
    return draw_postures_within(model, low, high, rng, RANDOM_STATES)


def measure_recorded_rates(samples: Iterable[Samples]) -> tuple[Array, Array]:
    """Return the standard deviations of velocities and accelerations of samples, each (n,)."""
    count = 0
    sums = np.zeros((2, 1))
    for batch, span in ((sample, span) for sample in samples for span in sample.spans()):
        rates = (batch.qd[span], batch.qdd[span])
        found = [
            np.concatenate([rate.sum(axis=0) for rate in rates]),
            np.concatenate([np.einsum("ij,ij->j", rate, rate) for rate in rates]),
        ]
        count = count + len(rates[0])
        sums = sums + np.vstack(found)
    mean, square = sums / max(count, 1)
    # Mean square less squared mean, in one pass; rounding can leave it below zero.
    velocity, acceleration = np.split(np.sqrt(np.maximum(square - mean**2, 0.0)), 2)
    return velocity, acceleration
