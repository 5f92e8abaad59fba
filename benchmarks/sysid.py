"""Armature, damping and dry friction of a servo arm from its command: against `mujoco.sysid`.

Both fit the same parameters (links and gains held at the truth) to the same windows, which MuJoCo's
own position actuators made, from the same start and on the same machine (compiled code of asbuilt
is compiled before); five robots with five commands are drawn. Both get the filtered state at the
start of each window: `mujoco.sysid` takes it as exact, asbuilt estimates it beside the parameters.
`mujoco.sysid` gets the logged positions at their times as positions of the state: as readings of
sensors they would be compared one step late, since its rollout stamps sensors, which are of the
state before a step, with the time after it. It comes with the mujoco package and needs the extra
`mujoco[sysid]`; without it, only asbuilt is measured. Times are CPU times [s] of all threads.
"""

from __future__ import annotations

import importlib
import time
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.description.load import bundled_robot
from asbuilt.description.model import DriveValues, RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.trajectories.refined_fit import refine_fit
from asbuilt.identification.trajectories.simulated_robot import ServoCoordinates
from asbuilt.identification.trajectories.windows import Windows, cut_windows

ROBOT = "ur10e"
DRIVE = DriveSet.parse("armature,viscous,coulomb")
STEP, RATE, DURATION, HORIZON = 1e-3, 100.0, 20.0, 0.5
NOISE = 2e-4
"""Noise of the positions [rad]."""
SEEDS = 5
"""Robots, commands and noises that are drawn."""


def measure() -> dict[str, float | str]:
    """Return CPU times, errors against the truth, coverage: mean, least and most of the seeds."""
    try:
        sysid = importlib.import_module("mujoco.sysid")
        sysid.optimize  # noqa: B018 - absent without the extra
    except (ImportError, AttributeError):
        sysid = None
    _one(0, None)
    each = [_one(seed, sysid) for seed in range(SEEDS)]
    found: dict[str, float | str] = {"parameters": 18.0}
    for name in each[0]:
        values = [one[name] for one in each]
        found |= {name: float(np.mean(values)), f"{name}, least": min(values)}
        found[f"{name}, most"] = max(values)
    if sysid is None:
        found["mujoco_sysid"] = "needs pip install 'mujoco[sysid]'"
    return found


def _one(seed: int, sysid: Any) -> dict[str, float]:
    """Return CPU times, errors and coverage for one seed."""
    model, servo = _truth(seed)
    recording = _recorded(model, servo, seed)
    start, truth = _start(model), _drives(model)
    windows = _windows(recording)
    began = time.process_time()
    own, errors = _by_asbuilt(start, recording, windows, servo)
    seconds = time.process_time() - began
    found = {
        "asbuilt_s": seconds,
        "asbuilt_error": _relative(own, truth),
        "asbuilt_covered": float(np.mean(np.abs(own - truth) < 1.96 * errors)),
    }
    if sysid is None:
        return found
    began = time.process_time()
    theirs, halves = _by_sysid(sysid, start, windows, servo)
    taken = time.process_time() - began
    error = _relative(theirs, truth)
    return found | {
        "mujoco_sysid_s": taken,
        "mujoco_sysid_error": error,
        "mujoco_sysid_covered": float(np.mean(np.abs(theirs - truth) < halves)),
        "ratio_mujoco_sysid": taken / seconds,
        "error_of_mujoco_sysid_over_ours": error / found["asbuilt_error"],
    }


def _truth(seed: int) -> tuple[RobotModel, PositionServo]:
    """Return the robot that is recorded, and its servo."""
    model = bundled_robot(ROBOT)
    rng = np.random.default_rng([seed, 1])
    size = np.array([4.0, 4.0, 2.0, 0.5, 0.5, 0.5])
    joints = tuple(
        replace(
            joint,
            drive=DriveValues(
                armature=float(0.3 * s * rng.uniform(0.5, 1.5)),
                viscous=float(4.0 * s * rng.uniform(0.5, 1.5)),
                coulomb=float(2.0 * s * rng.uniform(0.5, 1.5)),
            ),
        )
        for joint, s in zip(model.joints, size, strict=True)
    )
    kp = tuple((600.0 * size).tolist())
    servo = PositionServo(kp=kp, kd=tuple((20.0 * size).tolist()), delay=0.0)
    return replace(model, joints=joints), servo


def _start(model: RobotModel) -> RobotModel:
    """Return the robot with drive values half of the truth."""
    joints = tuple(
        replace(
            joint,
            drive=DriveValues(
                armature=0.5 * (joint.drive.armature or 0.0),
                viscous=0.5 * (joint.drive.viscous or 0.0),
                coulomb=0.5 * (joint.drive.coulomb or 0.0),
            ),
        )
        for joint in model.joints
    )
    return replace(model, joints=joints)


def _drives(model: RobotModel) -> Array:
    return np.array([[j.drive.armature, j.drive.viscous, j.drive.coulomb] for j in model.joints])


def _relative(found: Array, truth: Array) -> float:
    """Return the root mean square of relative errors."""
    return float(np.sqrt(np.mean((found / truth - 1.0) ** 2)))


def _specification(model: RobotModel, servo: PositionServo) -> Any:
    """Return MuJoCo's description with position actuators and sensors."""
    spec = mujoco.MjSpec.from_string(format_mjcf(model, actuators=False, shapes=False))
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    for name, kp, kd in zip(model.joint_names, servo.kp, servo.kd, strict=True):
        joint = spec.joint(name)
        joint.actfrclimited = False
        joint.solref_friction = [0.002, 1.0]
        joint.solimp_friction[:2] = [0.9999, 0.9999]
        actuator = spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        )
        actuator.gainprm[0], actuator.biasprm[:3] = kp, [0.0, -kp, -kd]
        spec.add_sensor(  # mujoco.sysid checks that there are as many as measured signals
            name=f"{name}_position",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )
    return spec


def _command(t: Array, n: int, seed: int) -> Array:
    rng = np.random.default_rng([seed, 2])
    rates = 2 * np.pi * np.array([0.15, 0.4, 0.9, 1.6])
    sizes, phases = rng.uniform(0.05, 0.25, (n, 4)), rng.uniform(0, 2 * np.pi, (n, 4))
    return np.stack(
        [(sizes[k] * np.sin(rates * t[:, None] + phases[k])).sum(axis=1) for k in range(n)], axis=1
    )


def _recorded(model: RobotModel, servo: PositionServo, seed: int) -> Recording:
    compiled = _specification(model, servo).compile()
    data, every = mujoco.MjData(compiled), round(1.0 / (RATE * STEP))
    t = np.arange(0.0, DURATION, 1.0 / RATE)
    u = _command(t, model.n_joints, seed)
    data.qpos[:] = u[0]
    q, qd = np.empty_like(u), np.empty_like(u)
    for k in range(len(t)):
        q[k], qd[k] = data.qpos, data.qvel
        data.ctrl[:] = u[k]
        mujoco.mj_step(compiled, data, every)
    measured = q + NOISE * np.random.default_rng([seed, 3]).standard_normal(q.shape)
    recording = Recording(
        t=t, q=measured, tau=np.zeros_like(u), command=u, joint_names=model.joint_names
    )
    return drive_by_command(recording, servo)


def _windows(recording: Recording) -> Windows:
    chain = SignalChain(cutoff=10.0, rests=True, parallel=False)
    return cut_windows(recording, prepare_samples(recording, chain), HORIZON)


def _by_asbuilt(
    start: RobotModel, recording: Recording, windows: Windows, servo: PositionServo
) -> tuple[Array, Array]:
    samples = prepare_samples(recording, SignalChain(cutoff=10.0))
    base = find_base_parameters(start, DRIVE)
    fit = fit_samples(start, [samples], base=base, method="entropic")
    refined = refine_fit(fit, [windows], servo, belief=np.inf, free=ServoCoordinates())
    return refined.robot.values, refined.value_errors


def _by_sysid(
    sysid: Any, start: RobotModel, windows: Windows, servo: PositionServo
) -> tuple[Array, Array]:
    spec = _specification(start, servo)
    compiled = spec.compile()
    parameters = sysid.ParameterDict()
    for joint in start.joints:
        for field, value in (
            ("armature", joint.drive.armature),
            ("damping", joint.drive.viscous),
            ("frictionloss", joint.drive.coulomb),
        ):
            parameters.add(
                sysid.Parameter(
                    f"{joint.name} {field}",
                    value,
                    0.0,
                    20.0 * (value or 1.0),
                    modifier=_modifier(joint.name, field),
                )
            )
    times = windows.step * np.arange(windows.n_steps + 1)
    positions = [(joint.name, sysid.SignalType.MjStateQPos) for joint in start.joints]
    inputs = windows.inputs()
    states, controls, measured = [], [], []
    for w in range(windows.n_windows):
        states.append(sysid.create_initial_state(compiled, windows.start_q[w], windows.start_qd[w]))
        held = np.concatenate([inputs[w], inputs[w][-1:]])
        controls.append(sysid.TimeSeries.from_control_names(times, held, compiled))
        measured.append(
            sysid.TimeSeries.from_names(windows.times, windows.q[w], compiled, positions)
        )
    sequences = sysid.ModelSequences(
        "arm",
        spec,
        [f"window {w}" for w in range(windows.n_windows)],
        states,
        controls,
        measured,
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    found, result = sysid.optimize(parameters, residual, verbose=False, max_iters=50)
    rest = residual(result.x, found)[0]
    _, halves = sysid.calculate_intervals(rest, result.jac)
    return found.as_vector().reshape(-1, 3), np.asarray(halves).reshape(-1, 3)


def _modifier(name: str, field: str) -> Any:
    def apply(spec: Any, parameter: Any) -> None:
        joint, value = spec.joint(name), float(parameter.value[0])
        if field == "damping":
            joint.damping[0] = value
        else:
            setattr(joint, field, value)

    return apply
