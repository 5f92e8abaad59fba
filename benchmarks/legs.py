"""Robots with legs that walk in MuJoCo, whose true bodies are known.

Feet stand on a floor by MuJoCo's contacts, and joints are driven by servos along postures in which
the feet are where they shall be. Pose, joints, torques and contact flags are logged with noise; the
flags say where a force of the floor is felt.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple
from xml.etree.ElementTree import SubElement, fromstring, tostring

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from asbuilt.description.model import RobotModel
from asbuilt.workflow.study import Study, identify
from asbuilt.writers.models.mjcf import export_mjcf
from legged_robots import LEGGED, SOLE, Legged, standing
from outside_robot import Sensors, other_bodies

Array = NDArray[np.float64]

STEP = 5e-4
"""Time step of the simulation and of the servos [s]."""
RATE, SECONDS, SETTLING = 500.0, 20.0, 2.0
PLACE_NOISE, TURN_NOISE = 1e-4, 1e-4
"""Standard deviations of the pose of the base [m, rad]."""
COUNTS = 2.0**18
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
FORCE_NOISE = 1e-3
"""Standard deviation of a measured force in units of its largest range."""
FELT = 0.02
"""Force over the weight above which a contact's flag is 1."""
BRAKED = {"condim": "6", "friction": "0.8 0.02 0.01", "priority": "1"}
"""Feet of the Go2 in MuJoCo's menagerie: lengths of torsional and rolling friction [m]."""
STEEPEST = np.deg2rad(70.0)


@dataclass(frozen=True)
class Walk:
    """A robot, what it does, one log each, and for how long [s].

    It squats, sways and turns on its feet (`squat`), trots (`step`), jumps (`hop`), or moves its
    joints as it falls (`flight`). With `forces` those of the feet are logged in place of flags,
    with `command` what the servos are asked for in place of torques; their gains are known. Feet
    that are `braked` have torsional and rolling friction, as those of MuJoCo's own models have.
    """

    robot: str
    motions: tuple[str, ...]
    seconds: float = SECONDS
    method: str = "wls"
    forces: bool = False
    command: bool = False
    braked: bool = False

    @property
    def name(self) -> str:
        name = f"legs_{self.robot}_{'_'.join(self.motions)}_{self.seconds:g}s_{self.method}"
        name += "_forces" * self.forces + "_command" * self.command
        return name + "_braked" * self.braked


class Stage(NamedTuple):
    """A robot in MuJoCo; `feet` are body, point on it (3,) and shapes that touch."""

    m: mujoco.MjModel
    feet: list[tuple[int, Array, set[int]]]
    weight: float
    rest: Array


def parameter_errors(walk: Walk, repetitions: int) -> Iterator[tuple[Array, Array]]:
    """Yield the errors of base parameters (p,) of a study and their standard errors."""
    for seed in range(repetitions):
        truth, study = studied(walk, seed)
        yield against_truth(truth, study)


def studied(walk: Walk, seed: int) -> tuple[RobotModel, Study]:
    """Return a robot as it is, and the study of its logs."""
    legged, rng = LEGGED[walk.robot], np.random.default_rng(seed)
    cad = described(walk.robot)
    truth = other_bodies(cad, rng)
    logs = [
        recorded(legged, truth, kind, walk.seconds, rng, walk.forces, walk.command, walk.braked)
        for kind in walk.motions
    ]
    if not walk.command:
        return truth, identify(cad, logs, torque_source="motor", method=walk.method)
    gains = {"torque_source": "command", "kp": (legged.kp,), "kd": (legged.kd,)}
    return truth, identify(cad, logs, method=walk.method, **gains)


@cache
def described(robot: str) -> RobotModel:
    """Return a robot by its description."""
    return LEGGED[robot].model()


def against_truth(truth: RobotModel, study: Study) -> tuple[Array, Array]:
    """Return the errors of the base parameters of a study and their standard errors."""
    base = study.result.base
    known = dict(zip(base.standard_names, truth.parameters, strict=False))
    for k, joint in enumerate(truth.joints):
        known |= {f"Fv{k + 1}": joint.drive.viscous or 0.0, f"Ia{k + 1}": joint.drive.armature}
    values = [known.get(name) or 0.0 for name in base.standard_names]
    return study.result.estimates - base.values(np.array(values)), study.result.std_errors


def recorded(
    legged: Legged,
    model: RobotModel,
    kind: str,
    seconds: float,
    rng: np.random.Generator,
    forces: bool = False,
    command: bool = False,
    braked: bool = False,
) -> dict[str, Array]:
    """Return the log of a motion; the robot falls freely if it is `flight`.

    A `command` is logged in place of torques; it is held until the next sample.
    """
    stage = staged(legged, model, braked)
    goal = goals(stage, kind, seconds + SETTLING, rng)
    log = simulated(legged, stage, goal, kind == "flight", rng, command)
    return _columns(legged, model, log, rng, forces, command)


def staged(legged: Legged, model: RobotModel, braked: bool = False) -> Stage:
    """Return a robot that stands on a floor, with balls or the corners of soles at its contacts."""
    root = fromstring(export_mjcf(model))
    for geom in root.iter("geom"):
        geom.set("contype", "0")
        geom.set("conaffinity", "0")
    world, bodies = next(iter(root.iter("worldbody"))), list(root.iter("body"))
    stiff = {"solref": "0.004 1", "friction": "1 .005 .0001"}
    SubElement(world, "geom", {"name": "floor", "type": "plane", "size": "99 99 1"} | stiff)
    touch = stiff | (BRAKED if braked else {})
    own: dict[str, str] = {}
    for foot in legged.feet:
        sites = [each for each in root.iter("site") if each.get("name") == foot]
        body = next(each for each in bodies if each.get("name") == foot or {*sites} & {*each})
        x, y, z = map(float, (sites[0].get("pos", "0 0 0") if sites else "0 0 0").split())
        corners = SOLE if legged.sole else ((0.0, 0.0),)
        size = legged.radius or 1e-3
        below = size - legged.sole if legged.sole else 0.0
        own[foot] = body.get("name", "")
        for k, (along, across) in enumerate(corners):
            place = f"{x + along} {y + across} {z + below}"
            ball = {"name": f"{foot} {k}", "type": "sphere", "pos": place, "mass": "0"}
            SubElement(body, "geom", ball | {"size": str(size)} | touch)
    m = mujoco.MjModel.from_xml_string(tostring(root, encoding="unicode"))
    m.opt.timestep, m.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    m.jnt_limited[:] = 0
    m.opt.cone, m.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    feet = []
    for foot in legged.feet:
        shapes = {k for k in range(m.ngeom) if m.geom(k).name.startswith(f"{foot} ")}
        point = np.mean([m.geom_pos[k] for k in shapes], axis=0)
        feet.append((m.body(own[foot]).id, point, shapes))
    weight = 9.81 * float(np.sum(m.body_mass))
    return Stage(m, feet, weight, standing(legged, model.joint_names[6:]))


def goals(stage: Stage, kind: str, seconds: float, rng: np.random.Generator) -> CubicSpline:
    """Return the positions of the joints over time that the servos are asked for."""
    t = np.arange(0.0, seconds + 0.1, 0.02)
    fade = 0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, t / SETTLING)[:, None])
    biped = len(stage.feet) == 2
    if kind == "flight":
        sway = (0.25 if biped else 0.5) * _sines(t, len(stage.rest), 0.5, 2.0, rng)
        return CubicSpline(t, stage.rest + fade * sway)
    start = _standing(stage)
    height = start[2]
    aside, fastest = (0.02, 0.5) if biped else (0.06, 1.0)
    size = np.r_[height * np.array([aside, aside, 0.12]), 0.12, 0.12, 0.12]
    base = size * _sines(t, 6, 0.1, fastest, rng)
    free = 0.4 * _sines(t, len(stage.rest), 0.1, fastest, rng)
    lift = np.zeros((len(t), len(stage.feet)))
    if kind == "step":
        beat = np.sin(2.0 * np.pi * 1.6 * t)[:, None] * [1.0, -1.0, -1.0, 1.0]
        base *= 0.4
        lift = 0.12 * height * np.maximum(0.0, beat) ** 2
    elif kind == "hop":
        base *= 0.2
        base[:, 2] += 0.11 * height * np.sin(np.sqrt(1.5 * 9.81 / (0.11 * height)) * t)
    postures, found = [], start
    for k in range(len(t)):
        found = _posture(stage, found, start, fade[k] * base[k], fade[k] * lift[k], free[k])
        postures.append(found[7:])
    return CubicSpline(t, np.array(postures))


def _sines(t: Array, n: int, low: float, high: float, rng: np.random.Generator) -> Array:
    """Return sums of three sines (N, n) of frequencies between two [Hz], about 1 in size."""
    f = rng.uniform(low, high, (n, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 3))
    return np.asarray(np.sin(2.0 * np.pi * t[:, None, None] * f + phase).sum(axis=2) / 2.0)


def _standing(stage: Stage) -> Array:
    """Return the state (nq,) of a robot at rest whose feet touch the floor."""
    d = mujoco.MjData(stage.m)
    d.qpos[7:] = stage.rest
    mujoco.mj_kinematics(stage.m, d)
    lowest = min(
        d.geom_xpos[k][2] - stage.m.geom_size[k][0] for foot in stage.feet for k in foot[2]
    )
    d.qpos[2] -= lowest
    return np.array(d.qpos)


def _posture(
    stage: Stage, guess: Array, start: Array, base: Array, lift: Array, free: Array
) -> Array:
    """Return the state (nq,) with the feet where they stood, but for `lift` [m].

    The base is off by `base` from where it stood, its centre of mass in place of its x and y on two
    feet; joints that no foot needs are off by `free`.
    """
    m, soles = stage.m, len(stage.feet) == 2
    first, d = mujoco.MjData(m), mujoco.MjData(m)
    first.qpos[:] = start
    legs = set()
    for each in (first, d):
        each.qpos[:] = start if each is first else guess
        mujoco.mj_kinematics(m, each)
    for foot, _, _ in stage.feet:
        body = foot
        while m.body_dofadr[body] >= 6:
            legs.add(int(m.body_dofadr[body]))
            body = m.body_parentid[body]
    rest = [k for k in range(6, m.nv) if k not in legs]
    turn = np.zeros(4)
    mujoco.mju_euler2Quat(turn, base[3:], "XYZ")
    for _ in range(20):
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        rows, gaps, stood = [], [], []
        for k, (body, point, _) in enumerate(stage.feet):
            J, T = np.zeros((3, m.nv)), np.zeros((3, m.nv))
            at, was = (
                each.xpos[body] + each.xmat[body].reshape(3, 3) @ point for each in (d, first)
            )
            mujoco.mj_jac(m, d, J, T, at, body)
            stood.append(was)
            rows.append(J)
            gaps.append(was + np.array([0.0, 0.0, lift[k]]) - at)
            if soles:
                rows.append(T)
                gaps.append(_rotation(d.xquat[body], first.xquat[body]))
        J, T, C = np.zeros((3, m.nv)), np.zeros((3, m.nv)), np.zeros((3, m.nv))
        mujoco.mj_jac(m, d, J, T, d.qpos[:3].copy(), 1)
        where, wanted = d.qpos[:3].copy(), start[:3] + base[:3]
        if soles:
            mujoco.mj_jacSubtreeCom(m, d, C, 0)
            J[:2], where[:2] = C[:2], d.subtree_com[0][:2]
            wanted[:2] = np.mean(stood, axis=0)[:2] + base[:2]
        rows += [J, T, np.eye(m.nv)[rest]]
        gaps += [wanted - where, _rotation(d.qpos[3:7], turn)]
        gaps.append((start[7:] + free - d.qpos[7:])[[k - 6 for k in rest]])
        step = np.linalg.lstsq(np.vstack(rows), np.concatenate(gaps), rcond=1e-3)[0]
        mujoco.mj_integratePos(m, d.qpos, step, 1.0)
        if np.abs(step).max() < 1e-6:
            break
    return np.array(d.qpos)


def _rotation(quaternion: Array, wanted: Array) -> Array:
    """Return the rotation vector (3,) in world axes from one quaternion to another."""
    back, turn, vector = np.zeros(4), np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(back, quaternion)
    mujoco.mju_mulQuat(turn, wanted, back)
    mujoco.mju_quat2Vel(vector, turn, 1.0)
    return vector


def simulated(
    legged: Legged,
    stage: Stage,
    goal: CubicSpline,
    falls: bool,
    rng: np.random.Generator,
    held: bool = False,
) -> Array:
    """Return rows of t, pose (7), joints, torques, felt contacts and wrenches at the feet.

    They begin at `SETTLING`; wrenches (6 a foot) are in axes of the feet, about their points. With
    `held` servos follow commands from sample to sample, which take the place of torques. Steps then
    are those of the leapfrog method, with implicit damping D as `step / 2 D` less armature, so that
    servos act on the positions and velocities of the same moment, and shorter, since Coriolis
    forces are early by half a step.
    """
    m, d = stage.m, mujoco.MjData(stage.m)
    step = STEP / 5.0 if held else STEP
    if held:
        m.opt.timestep = step
        m.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
        m.actuator_gainprm[:, 0], m.actuator_biasprm[:, 1:3] = legged.kp, [-legged.kp, -legged.kd]
        m.dof_armature[6:] -= 0.5 * step * (legged.kd + legged.viscous)
    d.qpos[:] = _standing(stage)
    if falls:
        m.geom_contype[:] = m.geom_conaffinity[:] = 0
        d.qvel[3:6] = rng.normal(0.0, 0.2, 3)
    steps = round(float(goal.x[-1] - 0.1) / step)
    times = np.arange(steps) * step
    wanted, rates = goal(times), goal(times, 1)
    every, force, rows = round(1.0 / RATE / step), np.zeros(6), []
    for k in range(steps):
        q = d.qpos.copy()
        if not held or k % every == 0:
            command = wanted[k] + legged.kd / legged.kp * rates[k]
        d.ctrl[:] = command
        if not held:
            d.ctrl[:] = legged.kp * (command - q[7:]) - legged.kd * d.qvel[6:]
        mujoco.mj_step(m, d)
        if k % every or times[k] < SETTLING:
            continue
        if abs(d.xmat[1][6]) > np.sin(STEEPEST):
            break
        felt, wrenches = np.zeros(len(stage.feet)), np.zeros((len(stage.feet), 2, 3))
        for number, contact in enumerate(d.contact[: d.ncon]):
            mujoco.mj_contactForce(m, d, number, force)
            for foot, (body, point, shapes) in enumerate(stage.feet):
                if shapes.isdisjoint(contact.geom.tolist()):
                    continue
                felt[foot] += force[0]
                f = contact.frame.reshape(3, 3).T @ force[:3]  # on the foot, the floor is first
                R = d.xmat[body].reshape(3, 3)
                arm = contact.pos - d.xpos[body] - R @ point
                wrenches[foot] += np.stack([f, np.cross(arm, f)]) @ R
        flags = felt > FELT * stage.weight
        driven = command if held else d.actuator_force
        rows.append(np.r_[times[k], q, driven, flags, wrenches.ravel()])
    return np.array(rows)


def _columns(
    legged: Legged,
    model: RobotModel,
    log: Array,
    rng: np.random.Generator,
    forces: bool,
    command: bool = False,
) -> dict[str, Array]:
    """Return the columns of a log, with noise; forces at feet in place of flags."""
    names, n = model.joint_names[6:], model.n_joints - 6
    sensors = Sensors(np.full(n, legged.noise), counts=COUNTS, turns=(True,) * n)
    feet = len(legged.feet)
    t, place, turn, q, tau, felt, f = np.split(log, np.cumsum([1, 3, 4, n, n, feet]), axis=1)
    place = place + rng.normal(0.0, PLACE_NOISE, place.shape)
    turn = turn + rng.normal(0.0, 0.5 * TURN_NOISE, turn.shape)
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    q = sensors.positions(q)
    tau = tau if command else tau + sensors.errors(rng, len(t), RATE)
    touch = {f"contact_{foot}": felt[:, k] for k, foot in enumerate(legged.feet)}
    if forces:
        columns = [f"contact_{foot}_{axis}" for foot in legged.feet for axis in WRENCH]
        scale = np.ptp(f, axis=0).max() * FORCE_NOISE
        touch = dict(zip(columns, (f + rng.normal(0.0, scale, f.shape)).T, strict=True))
    return (
        {"t": t[:, 0]}
        | {f"base_{axis}": place[:, k] for k, axis in enumerate("xyz")}
        | {f"base_q{axis}": turn[:, k] for k, axis in enumerate("wxyz")}
        | {f"q_{name}": q[:, k] for k, name in enumerate(names)}
        | {f"{'cmd' if command else 'tau'}_{name}": tau[:, k] for k, name in enumerate(names)}
        | touch
    )
