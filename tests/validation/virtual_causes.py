"""Robots that differ from their CAD in known ways, and what is identified of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from asbuilt.description import LinkInertia, load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.excitation import random_fourier
from asbuilt.experiment import (
    Recording,
    Samples,
    SensorNoise,
    SignalChain,
    VirtualRobot,
    hold_out,
    prepare_samples,
)
from asbuilt.experiment.virtual.presets import perturb_links
from asbuilt.identification import IdentificationResult, find_effects, identify_samples
from asbuilt.identification.information.cause_data import gather_cause_data

TOOL = LinkInertia.from_com(1.9, [0.02, 0.0, 0.08], np.diag([0.01, 0.01, 0.006]))
FRICTION = (1.0, 2.0)
"""Viscous [N m s/rad] and Coulomb [N m], of every joint."""
GAINS = {1: 1.1, 3: 0.9}
TILT = (1.0, -0.5)
"""Degrees about x and y."""


def recorded(
    robot: str, causes: str, *, seed: int = 1, friction: tuple[float, ...] = FRICTION
) -> Recording:
    """Log a robot with these causes: `pftgl` is payload, friction, tilt, gain, links."""
    model = load_robot(robot)
    n = model.n_joints
    machine = (
        VirtualRobot.ideal(model)
        .with_drive(DriveSet(), ())
        .with_noise(SensorNoise(torque_noise=0.1))
    )
    if "l" in causes:
        links = perturb_links(machine.model, 0.1, np.random.default_rng(4))
        machine = replace(machine, model=links)
    if "p" in causes:
        machine = machine.with_tool(TOOL)
    if "t" in causes:
        machine = machine.tilted(*np.deg2rad(TILT))
    if "f" in causes:
        machine = machine.with_drive(
            DriveSet.parse("viscous,coulomb"),
            np.tile(friction, n) if len(friction) == 2 else friction,
        )
    recording = machine.record(
        random_fourier(model, rng=3, duration=30.0), rate=100.0, rng=seed
    ).recording
    return recording.scaled([GAINS.get(k, 1.0) for k in range(n)]) if "g" in causes else recording


def divided(recording: Recording) -> tuple[Samples, Samples]:
    """Return the samples used, and those that are held out."""
    return hold_out(prepare_samples(recording, SignalChain()), "blocks:2s:3")


@cache
def identified(
    robot: str,
    causes: str,
    *,
    seed: int = 1,
    friction: tuple[float, ...] = FRICTION,
    drive: str = "viscous,coulomb,offset",
) -> IdentificationResult:
    """Identify it with the usual drive terms; every third 2 s block is held out and judges."""
    model = load_robot(robot)
    base = find_base_parameters(model, DriveSet.parse(drive))
    train, held = divided(recorded(robot, causes, seed=seed, friction=friction))
    effects = find_effects(model, base.drive, [train], applied=("tilt",))
    base = find_base_parameters(effects.model, effects.drive)
    result = identify_samples(effects.model, train, base=base)
    data = gather_cause_data(effects.model, base, [train], [held])
    return replace(result, cause_data=data, effects=effects.found)
