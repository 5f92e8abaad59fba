"""Sound logs of virtual robots whose descriptions are wrong: no `check` may refuse them.

The robots' torques are Pinocchio's; friction is a tenth to twice the torque of gravity. Each
description is wrong in one way, the log in none. And the reverse: logs with one real error, which
`check` must refuse.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.model import JointLimits, RobotModel
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.quality.checks import check_recording
from asbuilt.experiment.recording import Recording
from measurements import Run, count, resume
from outside_robot import OutsideRobot, Sensors, other_bodies, with_body

MAKES = ("kuka-iiwa7-r800", "franka-panda", "ur10e", "scara", "so-101")
RATE = 200.0
NOISE = 0.02
"""Torque noise in the torque of a joint."""


def with_limits(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """Return the description with placeholders for limits."""
    bound = float(rng.choice([0.1, 1.0]))
    own = JointLimits(lower=-bound, upper=bound, velocity=0.1, torque=1000.0)
    return replace(
        model,
        joints=tuple(
            replace(joint, limits=replace(joint.limits, velocity=0.1) if bound == 1.0 else own)
            for joint in model.joints
        ),
    )


def without_masses(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """Return the description with all or some links without mass."""
    share = float(rng.choice([1.0, 0.3]))
    left_out = rng.random(model.n_links) < share
    chi = model.parameters.reshape(-1, 10).copy()
    chi[left_out] = 0.0
    return model.with_parameters(chi.ravel())


def with_placeholder_masses(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """Return the description with one body for every link."""
    mass = float(rng.choice([0.1, 1.0, 10.0]))
    body = LinkInertia.from_com(mass, np.zeros(3), 1e-3 * mass * np.eye(3))
    return model.with_parameters(np.tile(body.parameters, model.n_links))


def with_shifted_masses(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """Return the description with each link's body in another place, or another link's body."""
    if rng.random() < 0.5:
        return model.with_parameters(np.roll(model.parameters.reshape(-1, 10), 1, axis=0).ravel())
    bodies = [
        LinkInertia.from_com(
            link.inertia.mass,
            link.inertia.com * rng.choice([-1.0, 1.0], size=3),
            link.inertia.inertia_about_com,
        )
        for link in model.links
    ]
    return model.with_parameters(np.concatenate([body.parameters for body in bodies]))


def with_other_zero(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """Return the description with one joint's zero off by up to 20 degrees."""
    k = int(rng.integers(model.n_joints))
    angle = float(rng.uniform(-0.35, 0.35))
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    joint = model.joints[k]
    own = replace(joint, before=np.asarray(joint.before) @ turn)
    return replace(model, joints=(*model.joints[:k], own, *model.joints[k + 1 :]))


def as_described(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """Return the description."""
    return model


DESCRIPTIONS: dict[str, Callable[[RobotModel, np.random.Generator], RobotModel]] = {
    "load": as_described,
    "placeholder limits": with_limits,
    "absent masses": without_masses,
    "placeholder masses": with_placeholder_masses,
    "shifted masses": with_shifted_masses,
    "another zero": with_other_zero,
}


def sound_log(
    make: str, rng: np.random.Generator, *, loaded: bool = False
) -> tuple[RobotModel, Recording]:
    """Return a description without drives and a sound log of a robot near it."""
    described = load_robot(make)
    model = replace(
        described,
        joints=tuple(replace(j, drive=type(j.drive)()) for j in described.joints),
    )
    bodies = other_bodies(model, rng, mass=0.1, centre=0.1, shape=0.1)
    if loaded:
        place = rng.normal(size=3) * 0.15
        mass = float(rng.uniform(0.2, 1.0)) * bodies.links[model.n_links // 2].inertia.mass
        load = LinkInertia.from_com(mass, place, 0.01 * mass * np.eye(3))
        bodies = with_body(bodies, int(rng.integers(model.n_links // 2, model.n_links)), load)
    motion = random_fourier(model, rng=rng, duration=float(rng.uniform(10.0, 30.0)))
    none = np.zeros(model.n_joints)
    bare = OutsideRobot(bodies, none, none, none, none)
    size = bare.logged(motion).tau.std(axis=0)
    share = rng.uniform(0.1, 2.0, size=(2, model.n_joints))
    robot = replace(bare, viscous=0.3 * share[0] * size, coulomb=share[1] * size, offset=0.1 * size)
    turns = tuple(joint.is_revolute for joint in model.joints)
    sensors = Sensors(NOISE * size, turns=turns, velocity=bool(rng.random() < 0.5))
    return model, robot.log(motion, sensors, RATE, rng, torque_source="motor")


def flip_one(log: Recording, rng: np.random.Generator) -> Recording:
    """Return the log with the torque of one joint flipped."""
    signs = np.ones(log.n_joints)
    signs[int(rng.integers(log.n_joints))] = -1.0
    return replace(log, tau=log.tau * signs)


LOGS: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    "degrees": lambda log, _: replace(
        log, q=np.degrees(log.q), qd=None if log.qd is None else np.degrees(log.qd)
    ),
    "flipped": lambda log, _: replace(log, tau=-log.tau),
    "one flipped": flip_one,
    "mN m": lambda log, _: replace(log, tau=1e3 * log.tau),
    "a twelfth": lambda log, _: replace(log, tau=log.tau / 12.0),
}
"""Logs with one real error."""


def check_sound(task: tuple[str, str, int]) -> dict[str, Any]:
    """Return what is said of one sound log, or of one with a real error."""
    make, case, seed = task
    rng = np.random.default_rng(seed)
    model, log = sound_log(make, rng, loaded=case == "load")
    if case in LOGS:
        log = LOGS[case](log, rng)
    else:
        model = DESCRIPTIONS[case](model, rng)
    found = check_recording(model, log)
    errors = {each.code: each.message for each in found.errors}
    return {"make": make, "case": case, "errors": errors}


def false_errors(robots: int, run: Run, out: Path | None) -> None:
    """Print in how many sound logs an error was found, and how many real errors were."""
    for title, cases, n in (
        ("sound logs of wrong descriptions, with an error", tuple(DESCRIPTIONS), robots),
        ("logs with a real error, refused", tuple(LOGS), robots // 4),
    ):
        tasks = [(MAKES[k // len(cases) % len(MAKES)], cases[k % len(cases)], k) for k in range(n)]
        path = None if out is None else out / "sound_logs.jsonl"
        found = list(resume(path, tasks, check_sound, run))
        print(f"{title}: {count([bool(each['errors']) for each in found])}")
        for case in cases:
            own = [each for each in found if each["case"] == case]
            codes = Counter(code for each in own for code in each["errors"])
            listed = ", ".join(f"{code} {count}" for code, count in codes.items())
            wrong = sum(bool(each["errors"]) for each in own)
            print(f"  {case:<20}{wrong:3d} of {len(own):3d}  {listed}", flush=True)
