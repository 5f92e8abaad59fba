"""Presets of virtual robots: ideal, in a laboratory, in a factory, with position servos."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import rotation_from_rpy
from asbuilt.dynamics import DriveSet, described_drive, inverse_dynamics, mass_matrix
from asbuilt.dynamics.kinematics import draw_postures_within
from asbuilt.errors import UsageError
from asbuilt.excitation.limits import MotionBounds
from asbuilt.experiment.virtual.drive_train import (
    DriveTrain,
    JointServo,
    PositionController,
    TermDrives,
)
from asbuilt.experiment.virtual.sensors import DataLogger, SensorNoise
from asbuilt.findings import Cure


def with_body(model: RobotModel, body: LinkInertia, at: str | None = None) -> RobotModel:
    """Return the robot with a body welded to a link or frame `at`, by default the last link.

    The body's inertia is given in the axes of that link or frame.

    Raises
    ------
    UsageError
        If the robot has no moving link or frame of that name.
    """
    index, placement = _find_flange(model, at)
    link = model.links[index]
    carried = body.moved(placement)
    links = list(model.links)
    links[index] = replace(
        link,
        inertia=link.inertia + carried,
        parts=(*(link.parts or ((link.name, link.inertia),)), ("tool", carried)),
    )
    return replace(model, links=tuple(links))


def perturb_links(model: RobotModel, fraction: float, rng: np.random.Generator) -> RobotModel:
    """Return the robot with every link stretched, sheared, shifted and scaled by about `fraction`.

    The pseudo-inertia becomes `s A J A^T` with `s = exp(fraction N)`, `A = [[1 + fraction N / 2,
    fraction r N / 2], [0, 1]]`, N standard normal, r the radius of gyration. A consistent link
    stays consistent, since congruence keeps J positive definite (Wensing et al. 2018).
    """
    links = []
    for link in model.links:
        J = link.inertia.pseudo_inertia
        radius = np.sqrt(max(np.trace(J[:3, :3]), 0.0) / J[3, 3]) if J[3, 3] > 0 else 0.0
        A = np.eye(4)
        A[:3, :3] += fraction / 2 * rng.normal(size=(3, 3))
        A[:3, 3] = fraction / 2 * radius * rng.normal(size=3)
        inertia = LinkInertia.from_pseudo_inertia(np.exp(fraction * rng.normal()) * A @ J @ A.T)
        links.append(replace(link, inertia=inertia, parts=()))
    return replace(model, links=tuple(links))


def tilt_base(model: RobotModel, roll: float, pitch: float) -> RobotModel:
    """Return the robot with its root turned by small angles [rad] about x, then y."""
    return model.with_gravity(rotation_from_rpy([roll, pitch, 0.0]).T @ model.gravity)


def estimate_torque_and_inertia(model: RobotModel, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return torque range and mean inertia of each joint, two (n,).

    The torque range is the limit, or without one the largest torque at random states.
    """
    bounds = MotionBounds.assumed(model)
    q = draw_postures_within(model, bounds.lower, bounds.upper, rng, 64)
    qd, qdd = (rng.uniform(-x, x, size=q.shape) for x in (bounds.velocity, bounds.acceleration))
    largest = np.max(np.abs(inverse_dynamics(model, q, qd, qdd)), axis=0)
    inertia = np.mean(np.diagonal(mass_matrix(model, q), axis1=1, axis2=2), axis=0)
    return np.where(np.isfinite(bounds.torque), bounds.torque, np.maximum(largest, 1.0)), inertia


def _find_flange(model: RobotModel, at: str | None) -> tuple[int, Array]:
    if at is None:
        return model.tool_link, np.eye(4)
    places = model.moving_places
    if at not in places:
        raise UsageError(
            f"{model.name} has no moving link or frame {at!r} to carry a tool; it has"
            f" {', '.join(places)}",
            value=at,
            available=[*places],
        )
    return places[at]


Engine = Literal["mujoco", "inverse-dynamics"]
FULL_DRIVE = "armature,viscous,coulomb,offset"

Parts = dict[str, Any]
"""Fields of `VirtualRobot`."""


def build_preset_parts(
    name: str, model: RobotModel, engine: str, rng: np.random.Generator
) -> Parts:
    """Return the fields of the preset robot of a description.

    Raises
    ------
    UsageError
        If there is no such preset or engine.
    """
    if engine not in PRESETS:
        raise UsageError(
            f"there is no engine {engine!r}; there are {', '.join(PRESETS)}",
            value=engine,
            available=list(PRESETS),
        )
    known = PRESETS[engine]
    if name not in known:
        others = {"engine": "mujoco"} if engine != "mujoco" and name in PRESETS["mujoco"] else {}
        raise UsageError(
            f"there is no virtual robot {name!r} on the engine {engine}; there are"
            f" {', '.join(known)}",
            cure=Cure("choose another engine", settings=others) if others else None,
            value=name,
            available=list(known),
        )
    return known[name](model, rng) | {"name": name}


def _build_exact(model: RobotModel, rng: np.random.Generator) -> Parts:
    drive, values = described_drive(model)
    return {
        "model": model,
        "train": TermDrives(drive, values),
        "controller": None,
        "logger": DataLogger(accelerations=True),
    }


def _build_typical(model: RobotModel, rng: np.random.Generator) -> Parts:
    n = model.n_joints
    torque, inertia = estimate_torque_and_inertia(model, rng)
    values = _draw_usual_drives(model, rng, 0.15 * inertia, torque)
    sensors = SensorNoise(
        encoder_counts=tuple(2.0**16 if joint.is_revolute else 1e5 for joint in model.joints),
        torque_noise=_list_floats(1e-3 * torque),
        torque_bias=_list_floats(1e-3 * torque * rng.normal(size=n)),
        torque_resolution=_list_floats(1e-4 * torque),
    )
    mass = 0.03 * sum(link.inertia.mass for link in model.links)
    gripper = LinkInertia.from_com(
        mass,
        np.array([0.0, 0.0, 0.06]) + rng.normal(scale=0.02, size=3),
        np.diag([1.0, 1.0, 0.5]) * mass * 0.05**2,
    )
    tilt = np.deg2rad(rng.normal(scale=0.3, size=2))
    built = with_body(perturb_links(model, 0.03, rng), gripper)
    return {
        "model": tilt_base(built, float(tilt[0]), float(tilt[1])),
        "described": model,
        "train": TermDrives(*_add_described_terms(model, DriveSet.parse(FULL_DRIVE), values.T)),
        "controller": None,
        "sensors": sensors,
        "logger": DataLogger(accelerations=True),
    }


def _build_ideal(model: RobotModel, rng: np.random.Generator) -> Parts:
    drive, values = described_drive(model)
    further = [key for key in drive.keys if key not in FULL_DRIVE.split(",")]
    if further:
        raise UsageError(
            f"the drives of {model.name} have the terms {', '.join(further)}, which MuJoCo does not"
            " simulate",
            cure=Cure("use the other engine, which has all", {"engine": "inverse-dynamics"}),
            value=further,
        )
    columns = np.reshape(values, (model.n_joints, -1)).T
    stated: Parts = {key: _list_floats(x) for key, x in zip(drive.keys, columns, strict=True)}
    return {
        "model": model,
        "train": DriveTrain(**stated),
        "controller": PositionController(feedforward="exact"),
        "logger": DataLogger(accelerations=True),
    }


def _build_lab(model: RobotModel, rng: np.random.Generator) -> Parts:
    torque, _ = estimate_torque_and_inertia(model, rng)
    train = _build_drive_train(model, rng)
    sensors = SensorNoise(
        encoder_counts=_choose_encoder_counts(model, 2**19),
        torque_noise=_list_floats(1e-3 * torque),
        torque_bias=_list_floats(1e-3 * torque * rng.normal(size=model.n_joints)),
        torque_ripple=_list_floats(1e-3 * torque),
        torque_resolution=_list_floats(1e-4 * torque),
    )
    built = perturb_links(model, 0.03, rng)
    phase = _list_floats(rng.uniform(0.0, 2 * np.pi, model.n_joints))
    return {
        "model": built,
        "described": model,
        "train": train,
        "sensors": replace(sensors, ripple_phase=phase),
        "torque": "sensor",
        "behind": 0.3,
    }


def _build_factory(model: RobotModel, rng: np.random.Generator) -> Parts:
    n = model.n_joints
    torque, _ = estimate_torque_and_inertia(model, rng)
    train = replace(
        _build_drive_train(model, rng),
        stiction=_list_floats(0.01 * torque * rng.uniform(0.5, 1.5, n)),
        stribeck_velocity=_list_floats(0.02 * MotionBounds.assumed(model).velocity),
        backlash=tuple(
            1.5e-4 * float(x) if joint.is_revolute else 2e-5
            for joint, x in zip(model.joints, rng.uniform(0.5, 1.5, n), strict=True)
        ),
        engagement=_list_floats(0.01 * torque),
        warming=0.1,
        warming_time=300.0,
    )
    sensors = SensorNoise(
        encoder_counts=_choose_encoder_counts(model, 2**16),
        torque_noise=_list_floats(1e-2 * torque),
        torque_gain=_list_floats(1.0 + 0.03 * rng.normal(size=n)),
        torque_ripple=_list_floats(5e-3 * torque),
        torque_resolution=_list_floats(1e-3 * torque),
    )
    tilt = np.deg2rad(rng.normal(scale=0.3, size=2))
    return {
        "model": tilt_base(perturb_links(model, 0.08, rng), float(tilt[0]), float(tilt[1])),
        "described": model,
        "train": train,
        "sensors": replace(sensors, ripple_phase=_list_floats(rng.uniform(0.0, 2 * np.pi, n))),
        "logger": DataLogger(rate=250.0, clock_jitter=5e-5, dropped=0.005),
        "controller": PositionController(feedforward="gravity", bandwidth=15.0),
        "torque": "current",
    }


def _build_servo(model: RobotModel, rng: np.random.Generator) -> Parts:
    """Return a robot of position servos.

    Where the description states no gains, they give a bandwidth of 4 Hz with half the damping of a
    critically damped joint; where it states no drive value, it comes from `_build_drive_train`.
    """
    n = model.n_joints
    _, inertia = estimate_torque_and_inertia(model, rng)
    usual = _build_drive_train(model, rng)

    def values(name: str, other: Array) -> Array:
        stated = [getattr(joint.drive, name) for joint in model.joints]
        return np.array([b if a is None else a for a, b in zip(stated, other, strict=True)])

    spread = np.exp(0.25 * rng.normal(size=(3, n)))
    armature, viscous, coulomb = (
        values(name, usual.of(name, n)) * factor
        for name, factor in zip(("armature", "viscous", "coulomb"), spread, strict=True)
    )
    pole = 2.0 * np.pi * 4.0
    kp = values("kp", (inertia + armature) * pole**2)
    stated = any(joint.drive.kp is not None for joint in model.joints)
    kd = values("kd", np.zeros(n) if stated else kp / pole)
    return {
        "model": perturb_links(model, 0.08, rng),
        "described": model,
        "train": DriveTrain(
            armature=_list_floats(armature),
            viscous=_list_floats(viscous),
            coulomb=_list_floats(coulomb),
        ),
        "sensors": SensorNoise(encoder_counts=_choose_encoder_counts(model, 2**14)),
        "logger": DataLogger(rate=200.0),
        "controller": JointServo(kp=_list_floats(kp), kd=_list_floats(kd), delay=0.01),
    }


PRESETS: Mapping[str, Mapping[str, Callable[[RobotModel, np.random.Generator], Parts]]] = {
    "mujoco": {
        "ideal": _build_ideal,
        "lab": _build_lab,
        "factory": _build_factory,
        "servo": _build_servo,
    },
    "inverse-dynamics": {"ideal": _build_exact, "lab": _build_typical},
}
"""Presets of each engine by name."""


def _build_drive_train(model: RobotModel, rng: np.random.Generator) -> DriveTrain:
    """Return drives of the usual size for the torque range of each joint.

    A rotor that the whole range accelerates by 200 rad/s^2 (or 200 m/s^2), and the usual friction.
    """
    torque, _ = estimate_torque_and_inertia(model, rng)
    values = _draw_usual_drives(model, rng, 0.005 * torque, torque)
    armature, viscous, coulomb, offset = (_list_floats(row) for row in values)
    return DriveTrain(armature=armature, viscous=viscous, coulomb=coulomb, offset=offset)


def _draw_usual_drives(
    model: RobotModel, rng: np.random.Generator, armature: Array, torque: Array
) -> Array:
    """Return armature, viscous and Coulomb friction and offset of each joint (4, n), half off.

    Of the torque range (n,) friction is 1.5 % viscous at top speed and 2 % Coulomb, the offset
    0.5 %.
    """
    spread = rng.uniform(0.5, 1.5, size=(4, model.n_joints))
    signs = rng.choice([-1.0, 1.0], size=model.n_joints)
    viscous = 0.015 * torque / MotionBounds.assumed(model).velocity
    return np.stack([armature, viscous, 0.02 * torque, 0.005 * torque * signs]) * spread


def _add_described_terms(
    model: RobotModel, drive: DriveSet, values: Array
) -> tuple[DriveSet, Array]:
    """Return drive terms and values (n, columns_per_joint) with the further terms described."""
    described, stated = described_drive(model)
    whole = DriveSet((*drive.terms, *described.without(*drive.keys).terms))
    known = [
        dict(zip((*described.symbols, *drive.symbols), row, strict=True))
        for row in np.hstack([stated.reshape(model.n_joints, -1), values])
    ]
    return whole, np.array([[have[symbol] for symbol in whole.symbols] for have in known]).ravel()


def _choose_encoder_counts(model: RobotModel, per_turn: int) -> tuple[float, ...]:
    """Return encoder counts per turn, or per metre for sliding joints."""
    return tuple(float(per_turn) if joint.is_revolute else 2.0 * per_turn for joint in model.joints)


def _list_floats(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
