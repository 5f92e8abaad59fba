"""An identified arm, quiet recordings of it, and thresholds; for the rooms that watch it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from asbuilt import Observer, Thresholds, set_thresholds
from asbuilt.apps.watch.causal_filter import largest_velocity_error
from asbuilt.arrays import Array
from asbuilt.description import RobotModel, bundled_robot
from asbuilt.excitation import Trajectory, random_fourier
from asbuilt.experiment import Recording, VirtualRobot
from asbuilt.identification import IdentificationResult
from asbuilt.workflow import StudyOptions, identify

RATE = 200.0
LONGEST = 15.0
"""Duration [s] of every motion, of which a recording is the beginning; sets how fast it is."""
STEP = 1e-4
"""Resolution of the encoders [rad]."""
NOISE = 0.1
"""Standard deviation of the torque noise [N m]."""


@dataclass(frozen=True)
class WatchedRobot:
    """The robot that moves, its result, what that was made from, quiet recordings, thresholds."""

    robot: VirtualRobot
    result: IdentificationResult
    trained: Recording
    quiet: tuple[Recording, ...]
    thresholds: Thresholds

    @property
    def model(self) -> RobotModel:
        return self.result.model

    def record(self, seed: int, duration: float, external: Array | None = None) -> Recording:
        return recorded(self.robot, seed, duration, external)


def recorded(
    robot: VirtualRobot, seed: int, duration: float, external: Array | None = None
) -> Recording:
    """Record a motion, with an external torque (N, n) or (n,) on the joints."""
    whole = random_fourier(robot.model, rng=seed, duration=LONGEST).sample(RATE)
    kept = whole.t <= duration
    moved = Trajectory(*(x[kept] for x in (whole.t, whole.q, whole.qd, whole.qdd)))
    noise = NOISE * np.random.default_rng(seed).normal(size=moved.q.shape)
    torque = robot.exact_torque(moved.q, moved.qd, moved.qdd)
    return Recording(
        t=moved.t,
        q=np.round(moved.q / STEP) * STEP,
        qd=moved.qd,
        tau=torque + noise - (0.0 if external is None else external),
        joint_names=robot.model.joint_names,
        source=f"motion {seed}",
        torque_source="motor",
    )


@cache
def watched_robot() -> WatchedRobot:
    robot = VirtualRobot.typical(bundled_robot("kuka-iiwa7-r800"), rng=1)
    assert robot.described is not None
    trained = recorded(robot, 1, 15.0)
    options = StudyOptions(drive="armature,viscous,coulomb,offset", method="wls", effects="none")
    result = identify(robot.described, trained, options=replace(options, holdout=None)).result
    quiet = tuple(recorded(robot, seed, LONGEST) for seed in (2, 3, 4, 5))
    error = largest_velocity_error([(log.t, log.q, log.qd) for log in quiet])
    observer = Observer(result, velocity_error=error)
    seen = [observer.observe(log.t, log.q, log.tau, log.qd) for log in quiet]
    thresholds = set_thresholds(
        seen,
        observer.model_error,
        result.model.joint_names,
        bandwidth=observer.bandwidth,
        velocity_error=error,
    )
    return WatchedRobot(robot, result, trained, quiet, thresholds)


@pytest.fixture(scope="session")
def watched() -> WatchedRobot:
    return watched_robot()
