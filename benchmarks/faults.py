"""Virtual recordings with one fault that the model lacks, and studies of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.workflow.study import Study, identify
from asbuilt.workflow.study_options import StudyOptions

Array = NDArray[np.float64]

DURATION, NOISE, CORRELATION_TIME = 40.0, 0.3, 0.1
FITTED = DriveSet.parse("viscous,coulomb,offset")
FRICTION = (1.0, 2.0, 0.3)
RICHER = DriveSet.parse("viscous,coulomb,stribeck:velocity=0.1,offset")
TILT, COUNTS = np.deg2rad(0.5), 4096


RATES = {"none": 200.0, "stribeck": 200.0, "tilt": 200.0, "counts": 1000.0}
"""Rate [Hz] of the recordings of each fault."""


def recorded(model: RobotModel, fault: str, seed: int) -> Recording:
    """Return a recording with coloured noise, a motion of its own, and what the fault does."""
    rng, rate = np.random.default_rng(seed), RATES[fault]
    motion = random_fourier(model, rng=rng, duration=DURATION, n_harmonics=5)
    clean = _machine(model, fault).record(motion, rate=rate).recording
    forget, warm_up = np.exp(-1.0 / (rate * CORRELATION_TIME)), int(20 * rate * CORRELATION_TIME)
    white = rng.normal(size=(clean.n_samples + warm_up, model.n_joints))
    noise = lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], white, axis=0)[warm_up:]
    q, tau = np.array(clean.q), np.array(clean.tau)
    if fault == "counts":
        step = 2.0 * np.pi / COUNTS
        q = np.where([joint.is_revolute for joint in model.joints], step * np.round(q / step), q)
    return replace(clean, q=q, tau=tau + NOISE * noise, qd=None, qdd=None)


def studies(model: RobotModel, fault: str, repetitions: int) -> Iterator[Study]:
    """Yield the studies of recordings with a fault by weighted least squares without it."""
    options = StudyOptions(drive=FITTED, method="wls", checked=False)
    for seed in range(repetitions):
        yield identify(model, recorded(model, fault, seed), options=options)


def _machine(model: RobotModel, fault: str) -> VirtualRobot:
    if fault == "tilt":
        turned = Rotation.from_rotvec([TILT, 0.0, 0.0]).apply(np.array(model.gravity))
        model = model.with_gravity(turned)
    viscous, coulomb, offset = FRICTION
    drive, values = (
        (RICHER, (viscous, coulomb, 0.5 * coulomb, offset))
        if fault == "stribeck"
        else (FITTED, FRICTION)
    )
    return VirtualRobot.ideal(model).with_drive(drive, np.tile(values, model.n_joints))
