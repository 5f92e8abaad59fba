"""mujoco.sysid: every link by its pseudo-inertia, damping, friction loss and armature of joints.

Its parameters, modifiers, bounds and optimiser; the residual is the torque of MuJoCo's inverse
dynamics at the filtered states (its "custom residual"), since these logs hold torques of arms that
fall within a window if they are simulated open loop. A torque offset of each joint is a bias.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from adapter import Estimate, Facts, Fit
from mujoco import sysid
from mujoco_rollout import STEP, simulated, without_limits
from plain import Motion, plain_motion, uniform

PACKAGE = "mujoco"
REQUIRES = ["mujoco[sysid]>=4.0", "scipy"]
TITLE = "mujoco.sysid"
ADDRESS = "https://github.com/google-deepmind/mujoco/tree/main/python/mujoco/sysid"
ROWS = 500
"""Samples of all logs; each costs an inverse dynamics for each of some ninety parameters."""
ITERATIONS = 30
WINDOWS = 60
"""Windows of training that are simulated, evenly from all."""


def fit(facts: Facts) -> Fit:
    """Identify by nonlinear least squares."""
    if facts.coupling is not None:
        raise NotImplementedError("no coupling of several joints with one motor in this adapter")
    spec = specification(facts, facts.urdf)
    model = spec.compile()
    motions = facts.plain()
    motion = thinned(motions, ROWS, facts.edge)
    scale = np.sqrt(np.mean(motion.tau**2, axis=0))  # as its `normalize_residual`
    parameters = sysid.ParameterDict()
    for name in facts.tree_links:
        parameters.add(body_parameter(spec, model, name))
    speed = np.std(motion.qd, axis=0)
    for k, joint in enumerate(facts.joints):
        largest = {
            "damping": scale[k] / speed[k],
            "frictionloss": scale[k],
            **({"armature": scale[k] / np.std(motion.qdd[:, k])} if facts.armature else {}),
        }
        for field, top in largest.items():
            parameters.add(parameter(f"{field}_{joint}", 0.1 * top, 0.0, 5.0 * top, joint, field))
        parameters.add(sysid.Parameter(f"offset_{joint}", 0.0, -5.0 * scale[k], 5.0 * scale[k]))

    def residual(x: Any, params: Any, **_: Any) -> Any:
        columns = x[:, None] if x.ndim == 1 else x
        rows = []
        for column in columns.T:
            params.update_from_vector(column)
            model = sysid.apply_param_modifiers(params, spec)
            bias = [params[f"offset_{joint}"].value[0] for joint in facts.joints]
            rows.append(((torque(model, facts, motion) + bias - motion.tau) / scale).ravel())
        found = np.array(rows).T
        return [found[:, 0] if x.ndim == 1 else found], None, None

    found, result = sysid.optimize(parameters, residual, verbose=False, max_iters=ITERATIONS)
    rest = residual(result.x, found)[0]
    _, halves = sysid.calculate_intervals(rest, result.jac)
    found.update_from_vector(result.x)
    last = sysid.apply_param_modifiers(found, spec)
    bias = np.array([found[f"offset_{joint}"].value[0] for joint in facts.joints])
    return Fit(
        lambda states: torque(last, facts, states) + bias,
        estimates(found, halves, facts),
        links(last, facts),
    )


def follow(facts: Facts) -> list[Any]:
    """Identify from commands by trajectories, and simulate the windows of the tests."""
    spec = specification(facts, facts.description)
    spec.option.timestep = STEP
    for name in facts.joints:
        kind, joint = mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT
        spec.add_sensor(name=name, type=kind, objtype=joint, objname=name)
    model, parameters = spec.compile(), sysid.ParameterDict()
    for key in ("damping", "frictionloss", "armature"):
        for name in facts.joints:
            start = float(getattr(model.joint(name), key)[0])
            top = max(10.0 * start, 0.1)
            parameters.add(parameter(f"{key}_{name}", start, 0.0, top, name, key))
    if "kp" not in facts.settings:
        parameters.add(stiffness(facts.joints, float(model.actuator_gainprm[0, 0])))
    windows = [window for log in facts.logs() for window in training_windows(facts, log)]
    chosen = np.linspace(0, len(windows) - 1, min(WINDOWS, len(windows))).astype(int)
    sequences = sysid.ModelSequences(
        "robot",
        spec,
        [f"window_{k}" for k in chosen],
        [sysid.create_initial_state(model, *windows[k][:2]) for k in chosen],
        [series(facts, windows[k][2], model, "control") for k in chosen],
        [series(facts, windows[k][3], model, "sensor") for k in chosen],
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=1)
    found, _ = sysid.optimize(parameters, residual, verbose=False, max_iters=ITERATIONS)
    model = sysid.apply_param_modifiers(found, spec)
    return [simulated(facts, model, log) for log in facts.logs(facts.test)]


def stiffness(joints: list[str], start: float) -> Any:
    """Return the stiffness of servos that are all alike."""

    def modifier(spec: Any, param: Any) -> None:
        for name in joints:
            sysid.apply_pgain(spec, name, float(param.value[0]))

    return sysid.Parameter("kp", start, 0.1, 10.0 * start, modifier=modifier)


def training_windows(facts: Facts, log: dict[str, Any]) -> list[tuple[Any, ...]]:
    """Return state at the start, command and positions of windows one after another."""
    states = plain_motion(log["t"], log["q"], None, facts.rate, facts.cutoff)
    inner, length = states.inner(), round(facts.horizon * facts.rate)
    command, q = (uniform(log["t"], log[key], states.t) for key in ("u", "q"))
    return [
        (states.q[k], states.qd[k], command[k : k + length], q[k : k + length])
        for k in range(inner.start, inner.stop - length, length)
    ]


def series(facts: Facts, values: Any, model: Any, kind: str) -> Any:
    """Return columns at the rate of the logs as its time series."""
    series = sysid.TimeSeries
    maps = {
        "control": series.compute_all_control_mapping,
        "sensor": series.compute_all_sensor_mapping,
    }
    return series(np.arange(len(values)) / facts.rate, values, maps[kind](model))


def specification(facts: Facts, path: str) -> Any:
    """Return the robot as MuJoCo reads it, without limits and contacts."""
    spec = mujoco.MjSpec.from_file(path)
    spec.compiler.balanceinertia, spec.compiler.boundinertia = True, 1e-6
    spec.option.gravity = facts.gravity
    without_limits(spec)
    for name in facts.joints:
        joint = spec.joint(name)
        joint.solref_friction = [0.002, 1.0]
        joint.solimp_friction[:2] = [0.9999, 0.9999]
    return spec


def body_parameter(spec: Any, model: Any, name: str) -> Any:
    """Return the ten parameters of a body.

    Its own modifier leaves the orientation at NaN, with which MuJoCo 4.0.0 compiles no inertia.
    """

    def modifier(spec: Any, param: Any) -> None:
        sysid.apply_body_inertia(spec, name, param)
        spec.body(name).iquat[:] = [1.0, 0.0, 0.0, 0.0]

    kind = sysid.InertiaType.Pseudo
    return sysid.body_inertia_param(spec, model, name, inertia_type=kind, modifier=modifier)


def parameter(name: str, value: float, low: float, high: float, joint: str, field: str) -> Any:
    """Return a parameter of a joint."""

    def modifier(spec: Any, param: Any) -> None:
        place, number = spec.joint(joint), float(param.value[0])
        if field == "damping":
            place.damping[0] = number
        else:
            setattr(place, field, number)

    return sysid.Parameter(name, value, low, high, modifier=modifier)


def thinned(motions: list[Motion], rows: int, edge: float) -> Motion:
    """Return so many samples of all logs, evenly."""
    parts = []
    for motion in motions:
        inner = motion.inner(edge)
        count = rows // len(motions)
        at = np.linspace(inner.start, inner.stop - 1, count).astype(int)
        parts.append(Motion(*(x[at] for x in motion)))
    return Motion(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def torque(model: Any, facts: Facts, motion: Motion) -> Any:
    """Return the torque (N, n) of MuJoCo's inverse dynamics.

    Columns are put in MuJoCo's order for all samples at once: the loop is what the fit waits for.
    """
    data = mujoco.MjData(model)
    q = [model.joint(name).qposadr[0] for name in facts.joints]
    v = [model.joint(name).dofadr[0] for name in facts.joints]
    qpos = np.tile(data.qpos, (len(motion.t), 1))
    qvel = np.tile(data.qvel, (len(motion.t), 1))
    qacc, found = np.zeros_like(qvel), np.empty_like(qvel)
    qpos[:, q], qvel[:, v], qacc[:, v] = motion.q, motion.qd, motion.qdd
    own = data.qpos, data.qvel, data.qacc, data.qfrc_inverse
    for row, speed, change, out in zip(qpos, qvel, qacc, found, strict=True):
        own[0][:], own[1][:], own[2][:] = row, speed, change
        mujoco.mj_inverse(model, data)
        out[:] = own[3]
    return found[:, v]


def estimates(found: Any, halves: Any, facts: Facts) -> list[Estimate]:
    """Return parameters with their errors; of damping and friction loss also what they are."""
    values, names = found.as_vector(), []
    for key in list(found.keys()):
        names += [f"{key}[{i}]" for i in range(found[key].size)]
    symbols = {"damping": "Fv", "frictionloss": "Fc", "armature": "Ia", "offset": "Fo"}
    own = {
        f"{field}_{joint}[0]": {f"{symbol}{k + 1}": 1.0}
        for field, symbol in symbols.items()
        for k, joint in enumerate(facts.joints)
    }
    return [
        Estimate(name, float(value), float(half) / 1.96, own.get(name, {}))
        for name, value, half in zip(names, values, halves, strict=True)
        if np.isfinite(half)
    ]


def links(model: Any, facts: Facts) -> Any:
    """Return parameters (n_links, 10) about the frames of the links."""
    rows = []
    for name in facts.tree_links:
        k = model.body(name).id
        m, c, R = model.body_mass[k], model.body_ipos[k], np.zeros(9)
        mujoco.mju_quat2Mat(R, model.body_iquat[k])
        R = R.reshape(3, 3)
        I = R @ np.diag(model.body_inertia[k]) @ R.T + m * (c @ c * np.eye(3) - np.outer(c, c))
        rows.append([I[0, 0], I[0, 1], I[0, 2], I[1, 1], I[1, 2], I[2, 2], *(m * c), m])
    return np.array(rows)
