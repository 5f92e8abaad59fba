"""Torque gains and delays of robots whose torque another engine computes, with their true values.

Bodies are off from CAD as usual, friction is viscous and Coulomb's; every trial has motions of its
own, torque noise that lasts, encoder counts and the rate of a controller.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.inertia import LinkInertia, shift_matrix
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import MotionFilters, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.calibration.delay import find_delays
from asbuilt.identification.calibration.payload import choose_payload_frame
from asbuilt.identification.calibration.torque_gains import identify_gains
from outside_robot import FINE, Engine, Logged, OutsideRobot, Sensors, other_bodies, with_body

Array = NDArray[np.float64]

DRIVE = DriveSet.parse("viscous,coulomb,offset")
TOOL = LinkInertia.from_com(3.0, [0.03, -0.02, 0.09], np.diag([0.012, 0.015, 0.009]))
LONGEST_DELAY = 0.02
LARGEST_GAINS = (5.0, 15.0)


@dataclass(frozen=True, slots=True)
class Setting:
    """A robot, the length [s] and rate [Hz] of its logs, encoder counts, torque noise [N m] and the
    time over which that is correlated [s]."""

    robot: str
    duration: float
    rate: float = 200.0
    counts: float = 2.0**18
    noise: float = 0.1
    correlation_time: float = 0.1

    @property
    def name(self) -> str:
        return (
            f"{self.robot}_{self.duration:g}s_{self.rate:g}hz_{self.counts:.0f}_counts_noise_of"
            f"_{self.noise:g}_over_{self.correlation_time:g}s"
        )


def delay_errors(
    setting: Setting, repetitions: int, engine: Engine = "pinocchio"
) -> Iterator[tuple[Array, Array]]:
    """Yield the error of the delay (1,) of a log and its standard error, [s]."""
    for seed in range(repetitions):
        rng, (model, robot) = np.random.default_rng(seed), _robot(setting, seed, engine)
        delay = float(rng.uniform(-0.25, 1.0) * LONGEST_DELAY)
        log = _recorded(setting, model, _moved(setting, model, robot, rng), rng, delay)
        chain = resolve_chain(SignalChain(), log)
        motion = MotionFilters().prepare(log, chain)
        found = find_delays(
            model,
            lambda delays, motion=motion: [motion.samples(tuple(delays[0].tolist()))],
            drive=DRIVE,
            count=1,
        )
        yield found.estimates - delay, found.std_errors


def gain_errors(
    setting: Setting, repetitions: int, engine: Engine = "pinocchio"
) -> Iterator[tuple[Array, Array]]:
    """Yield the relative errors of the gains (n,), NaN where undetermined, and standard errors."""
    for seed in range(repetitions):
        rng, (model, bare) = np.random.default_rng(seed), _robot(setting, seed, engine)
        frame, link, placement = choose_payload_frame(model)
        tool = LinkInertia(shift_matrix(placement) @ TOOL.parameters)
        loaded = replace(bare, bodies=with_body(bare.bodies, link, tool))
        gains = rng.uniform(*LARGEST_GAINS, model.n_joints)
        filters, logs = MotionFilters(), list[Recording]()
        for robot in (bare, loaded):
            moved = _moved(setting, model, robot, rng)
            log = _recorded(setting, model, moved, rng)
            logs.append(replace(log, tau=log.tau / gains, torque_source="current"))
        chain = resolve_chain(SignalChain(), *logs)
        samples = [filters.prepare(log, chain).samples() for log in logs]
        found = identify_gains(model, *samples, mass=TOOL.mass, drive=DRIVE, frame=frame)
        off = np.where(found.determined, found.gains / gains - 1.0, np.nan)
        yield off, found.std_errors / gains


def _robot(setting: Setting, seed: int, engine: Engine) -> tuple[RobotModel, OutsideRobot]:
    """Return a robot by CAD, and as it is."""
    described = load_robot(setting.robot)
    bare = tuple(replace(joint, drive=type(joint.drive)()) for joint in described.joints)
    model, rng = replace(described, joints=bare), np.random.default_rng(seed)
    drives = (np.full(model.n_joints, each) for each in (1.0, 2.0, 0.3, 0.0))
    return model, OutsideRobot(other_bodies(model, rng), *drives, engine=engine)


def _moved(
    setting: Setting, model: RobotModel, robot: OutsideRobot, rng: np.random.Generator
) -> Logged:
    harmonics = int(setting.duration)
    return robot.logged(
        random_fourier(model, rng=rng, duration=setting.duration, n_harmonics=harmonics), FINE
    )


def _recorded(
    setting: Setting,
    model: RobotModel,
    moved: Logged,
    rng: np.random.Generator,
    delay: float = 0.0,
) -> Recording:
    """Return what is logged of a motion."""
    turns = tuple(joint.is_revolute for joint in model.joints)
    sensors = Sensors(
        np.full(model.n_joints, setting.noise),
        counts=setting.counts,
        turns=turns,
        correlation_time=setting.correlation_time,
    )
    ticks = np.arange(int(moved.t[-1] * setting.rate) + 1) / setting.rate
    q, tau = (
        np.column_stack([np.interp(times, moved.t, each) for each in x.T])
        for times, x in ((ticks, moved.q), (ticks - delay, moved.tau))
    )
    return Recording(
        t=ticks,
        q=sensors.positions(q),
        tau=tau + sensors.errors(rng, len(ticks), setting.rate),
        joint_names=model.joint_names,
        source="outside",
        torque_source="sensor",
    )
