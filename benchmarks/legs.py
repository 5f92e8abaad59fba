"""Virtual walking robots in MuJoCo, whose truth is known: how often 95 % intervals hold it.

    python benchmarks/legs.py MODEL CONTACTS [--motion squat,trot,hop,flight] [--seeds 4]

MODEL is a URDF or MJCF with legs. Each link is made up to 15 % heavier or lighter, the feet stand
on a floor by MuJoCo's contacts, joints are driven by servos, and pose, joints, torques and contact
flags are logged with noise. One JSON line a seed: error held out as built and of CAD, the share of
base parameters whose 95 % interval holds the truth, and the total mass.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from xml.etree.ElementTree import SubElement, fromstring, tostring

import mujoco
import numpy as np

from asbuilt import identify
from asbuilt.arrays import Array
from asbuilt.description.load import load_robot
from asbuilt.description.model import Contact, RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.writers.models.mjcf import exported_mjcf

NOISE = {"position": 2e-5, "torque": 0.02, "place": 2e-5, "turn": 2e-5}
"""Standard deviations [rad, N m per 10 kg, m, rad]: encoders, drives, motion capture, filtered."""
VISCOUS = 0.02
"""Damping of every joint [N m s/rad]."""
RATE, SECONDS = 500.0, 20.0


def altered(model: RobotModel, rng: np.random.Generator) -> RobotModel:
    """Return the robot with every link up to 15 % heavier or lighter, and damping."""
    chi = model.parameters.reshape(-1, 10) * rng.uniform(0.85, 1.15, (model.n_links, 1))
    other = model.with_parameters(chi.ravel())
    joints = tuple(
        replace(joint, drive=replace(joint.drive, viscous=VISCOUS, coulomb=None, armature=None))
        if k >= model.n_floating
        else joint
        for k, joint in enumerate(other.joints)
    )
    return replace(other, joints=joints)


def simulated(model: RobotModel, radius: float) -> mujoco.MjModel:
    """Return a robot for MuJoCo that stands on a floor with balls at its contacts."""
    root = fromstring(exported_mjcf(model))
    for geom in root.iter("geom"):
        geom.set("contype", "0")
        geom.set("conaffinity", "0")
    world = next(iter(root.iter("worldbody")))
    SubElement(world, "geom", name="floor", type="plane", size="9 9 1", friction="1 .005 .0001")
    for contact in model.contacts:
        site = next(each for each in root.iter("site") if each.get("name") == contact.frame)
        body = next(each for each in root.iter("body") if site in list(each))
        place = {"pos": site.get("pos", "0 0 0"), "size": str(radius), "mass": "0"}
        SubElement(body, "geom", {"name": f"ball {contact.frame}", "type": "sphere"} | place)
    return mujoco.MjModel.from_xml_string(tostring(root, encoding="unicode"))


def wanted(kind: str, t: float, rest: Array, phase: Array) -> Array:
    """Return the positions of the joints (n,) that the servos are asked for."""
    legs = rest.reshape(-1, 3)
    bend = np.sign(legs[:, 1:2])
    move = np.zeros_like(legs)
    if kind == "squat":
        w = 2.0 * np.pi * np.array([0.31, 0.53, 0.71])
        move[:, 0] = 0.15 * np.sin(w[0] * t + phase[0]) + 0.05 * np.sin(w[2] * t)
        deep = 0.2 * np.sin(w[1] * t + phase[1]) + 0.1 * np.sin(2.1 * w[2] * t + phase[2])
        lean = 0.12 * np.sin(w[2] * t + phase[0]) * np.array([1.0, 1.0, -1.0, -1.0])
        move[:, 1:2] = bend * (deep + lean)[:, None] if len(legs) == 4 else bend * deep
        move[:, 2:3] = -2.0 * move[:, 1:2] * 0.9
    elif kind in ("trot", "hop"):
        beat = 2.0 * np.pi * (1.6 if kind == "trot" else 1.3) * t
        side = np.array([0.0, 1.0, 1.0, 0.0]) * np.pi if kind == "trot" else np.zeros(4)
        lift = np.maximum(0.0, np.sin(beat + side[: len(legs)]))[:, None]
        if kind == "hop":
            lift = 0.5 * np.sin(beat) * np.ones((len(legs), 1))
        move[:, 1:2], move[:, 2:3] = bend * 0.35 * lift, -bend * 0.8 * lift
        move[:, 0] = 0.06 * np.sin(2.3 * t + phase[0]) + 0.05 * np.sin(5.1 * t + phase[1])
    else:
        w = 2.0 * np.pi * np.outer([0.7, 0.9, 1.1], np.ones(len(legs))).T
        move = 0.5 * np.sin(w * t + phase.reshape(-1)[: legs.size].reshape(legs.shape))
    return (legs + move).ravel()


def recorded(
    model: RobotModel, kind: str, rest: Array, rng: np.random.Generator
) -> dict[str, Array]:
    """Return the log of a motion; the robot falls freely if it is `flight`."""
    m = simulated(model, model.contacts[0].radius)
    d, feet = mujoco.MjData(m), [m.geom(f"ball {each.frame}").id for each in model.contacts]
    weight = float(np.sum(m.body_mass))
    kp, kd, phase = 8.0 * weight, 0.25 * weight, rng.uniform(0, 2 * np.pi, 12)
    m.opt.timestep, m.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    m.opt.cone, m.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    mujoco.mj_resetData(m, d)
    d.qpos[7:] = rest
    mujoco.mj_forward(m, d)
    d.qpos[2] = model.contacts[0].radius - min(d.geom_xpos[foot][2] for foot in feet)
    if kind == "flight":
        m.geom_contype[:], m.geom_conaffinity[:] = 0, 0
        d.qvel[:6] = [0, 0, 0, *rng.normal(0, 0.6, 3)]
    rows, every = [], round(1.0 / RATE / m.opt.timestep)
    seconds = 12.0 if kind == "flight" else SECONDS
    for step in range(round((seconds + 1.0) / m.opt.timestep)):
        t = step * m.opt.timestep
        fade = min(1.0, t)
        goal = rest + fade * (wanted(kind, t, rest, phase) - rest)
        d.ctrl[:] = kp * (goal - d.qpos[7:]) - kd * d.qvel[6:]
        mujoco.mj_step1(m, d)
        mujoco.mj_step2(m, d)
        if step % every == 0 and t >= 1.0:
            q, tau = d.qpos.copy(), d.actuator_force.copy()
            closed = np.zeros(len(feet))
            for k in range(d.ncon):
                closed[[f in d.contact[k].geom for f in feet]] = 1.0
            rows.append(np.concatenate([[t], q, tau, closed]))
    log = np.array(rows)
    return _columns(model, log, weight, rng)


def _columns(
    model: RobotModel, log: Array, weight: float, rng: np.random.Generator
) -> dict[str, Array]:
    names, n = model.joint_names[6:], model.n_joints - 6
    t, place, turn = log[:, 0], log[:, 1:4], log[:, 4:8]
    noisy = place + rng.normal(0, NOISE["place"], place.shape)
    turn = turn + rng.normal(0, 0.5 * NOISE["turn"], turn.shape)
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    q = log[:, 8 : 8 + n] + rng.normal(0, NOISE["position"], (len(t), n))
    tau = log[:, 8 + n : 8 + 2 * n] + rng.normal(0, NOISE["torque"] * weight / 10, (len(t), n))
    return (
        {"t": t}
        | {f"base_{axis}": noisy[:, k] for k, axis in enumerate("xyz")}
        | {f"base_q{axis}": turn[:, k] for axis, k in zip("wxyz", range(4), strict=True)}
        | {f"q_{name}": q[:, k] for k, name in enumerate(names)}
        | {f"tau_{name}": tau[:, k] for k, name in enumerate(names)}
        | {f"contact_{each.frame}": log[:, 8 + 2 * n + k] for k, each in enumerate(model.contacts)}
    )


def measured(model: RobotModel, rest: Array, motions: list[str], seed: int, method: str) -> dict:
    """Identify one robot and hold the result against the truth."""
    rng, began = np.random.default_rng(seed), time.process_time()
    truth = altered(model, rng)
    logs = [recorded(truth, kind, rest, rng) for kind in motions]
    study = identify(
        model,
        logs,
        holdout="last:0.25",
        method=method,
        drive=DriveSet.parse("viscous"),
        torque_source="motor",
    )
    result, validation = study.result, study.validations
    drive = result.base.drive
    chi = np.concatenate(
        [
            truth.parameters,
            *([[VISCOUS]] * 0),
            np.r_[np.zeros(6), np.full(truth.n_joints - 6, VISCOUS)],
        ]
    )
    exact = find_base_parameters(model, drive).values(chi)
    held = np.abs(result.estimates - exact) <= 1.96 * result.std_errors
    return {
        "robot": model.name,
        "motions": motions,
        "seed": seed,
        "method": method,
        "error": [round(v.metrics_as_built.relative_error, 4) for v in validation],
        "error_cad": [round(v.metrics_cad.relative_error, 4) for v in validation],
        "coverage": round(float(held.mean()), 3),
        "mass": [
            round(float(result.estimates[result.base.names.index("m6")]), 4),
            round(float(truth.parameters.reshape(-1, 10)[:, 9].sum()), 4),
        ],
        "cpu_seconds": round(time.process_time() - began, 1),
    }


def main() -> None:
    """Print one line a seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model")
    parser.add_argument("contacts", help="such as FL,FR,RL,RR")
    parser.add_argument("--motion", default="squat,trot,hop,flight")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--radius", type=float, default=0.02)
    parser.add_argument("--rest", default="0,0.8,-1.5", help="one leg's joints at rest [rad]")
    parser.add_argument("--method", default="wls")
    given = parser.parse_args()
    contacts = ",".join(
        str(replace(each, radius=given.radius)) for each in Contact.parse(given.contacts)
    )
    model = load_robot(given.model, base="free", contacts=contacts)
    leg = np.array([float(each) for each in given.rest.split(",")])
    rest = np.tile(leg, (model.n_joints - 6) // 3)
    for seed in range(given.seeds):
        found = measured(model, rest, given.motion.split(","), seed, given.method)
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
