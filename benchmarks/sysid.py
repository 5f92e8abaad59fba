"""Armature, damping and dry friction of a servo arm from its command: against `mujoco.sysid`.

Both fit the same parameters (links and gains held at the truth) to the same windows, which MuJoCo's
own position actuators made, from the same start and initial states and on the same machine
(compiled code of asbuilt is compiled before). `mujoco.sysid` gets the logged positions at their
times as positions of the state: as readings of sensors they would be compared one step late, since
its rollout stamps sensors, which are of the state before a step, with the time after it. It comes
with the mujoco package and needs the extra `mujoco[sysid]`; without it, only the times of asbuilt
are measured.
"""

from __future__ import annotations

import importlib
import time
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.catalogue import bundled_robot
from asbuilt.description.formats.mjcf_text import mjcf_text
from asbuilt.description.model import DriveValues, RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.experiment.command.servo_torque import driven_by_command
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.trajectories.refined_fit import refine_fit
from asbuilt.identification.trajectories.windows import Windows, cut_windows

ROBOT = "ur10e"
DRIVE = DriveSet.parse("armature,viscous,coulomb")
STEP, RATE, DURATION, HORIZON = 1e-3, 100.0, 20.0, 0.5
NOISE = 2e-4
"""Noise of the positions [rad]."""
HELD = 1e6
"""Weight of CAD that holds the links."""


def measure() -> dict[str, float | str]:
    """Return times, errors against the truth, and how many intervals cover it."""
    model, servo = _truth()
    recording = _recorded(model, servo)
    start = _start(model)
    windows = _windows(recording)
    _by_asbuilt(start, recording, windows, servo)
    began = time.perf_counter()
    own, errors = _by_asbuilt(start, recording, windows, servo)
    seconds = time.perf_counter() - began
    truth = _drives(model)
    found: dict[str, float | str] = {
        "asbuilt_s": seconds,
        "asbuilt_error": _relative(own, truth),
        "asbuilt_covered": float(np.mean(np.abs(own - truth) < 1.96 * errors)),
        "parameters": float(truth.size),
    }
    try:
        sysid = importlib.import_module("mujoco.sysid")
        sysid.optimize  # noqa: B018 - absent without the extra
    except (ImportError, AttributeError):
        return found | {"mujoco_sysid": "needs pip install 'mujoco[sysid]'"}
    began = time.perf_counter()
    theirs, halves = _by_sysid(sysid, start, windows, servo)
    taken = time.perf_counter() - began
    return found | {
        "mujoco_sysid_s": taken,
        "mujoco_sysid_error": _relative(theirs, truth),
        "mujoco_sysid_covered": float(np.mean(np.abs(theirs - truth) < halves)),
        "ratio_mujoco_sysid": taken / seconds,
    }


def _truth() -> tuple[RobotModel, PositionServo]:
    """Return the robot that is recorded, and its servo."""
    model = bundled_robot(ROBOT)
    rng = np.random.default_rng(1)
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
    spec = mujoco.MjSpec.from_string(mjcf_text(model, actuators=False, shapes=False))
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


def _command(t: Array, n: int) -> Array:
    rng = np.random.default_rng(3)
    rates = 2 * np.pi * np.array([0.15, 0.4, 0.9, 1.6])
    sizes, phases = rng.uniform(0.05, 0.25, (n, 4)), rng.uniform(0, 2 * np.pi, (n, 4))
    return np.stack(
        [(sizes[k] * np.sin(rates * t[:, None] + phases[k])).sum(axis=1) for k in range(n)], axis=1
    )


def _recorded(model: RobotModel, servo: PositionServo) -> Recording:
    compiled = _specification(model, servo).compile()
    data, every = mujoco.MjData(compiled), round(1.0 / (RATE * STEP))
    t = np.arange(0.0, DURATION, 1.0 / RATE)
    u = _command(t, model.n_joints)
    data.qpos[:] = u[0]
    q, qd = np.empty_like(u), np.empty_like(u)
    for k in range(len(t)):
        q[k], qd[k] = data.qpos, data.qvel
        data.ctrl[:] = u[k]
        mujoco.mj_step(compiled, data, every)
    measured = q + NOISE * np.random.default_rng(4).standard_normal(q.shape)
    recording = Recording(
        t=t, q=measured, tau=np.zeros_like(u), command=u, joint_names=model.joint_names
    )
    return driven_by_command(recording, servo)


def _windows(recording: Recording) -> Windows:
    chain = SignalChain(cutoff=10.0, rests=True, parallel=False)
    return cut_windows(recording, prepare_samples(recording, chain), HORIZON)


def _by_asbuilt(
    start: RobotModel, recording: Recording, windows: Windows, servo: PositionServo
) -> tuple[Array, Array]:
    samples = prepare_samples(recording, SignalChain(cutoff=10.0))
    base = find_base_parameters(start, DRIVE)
    fit = fit_samples(start, [samples], base=base, method="entropic")
    refined = refine_fit(fit, [windows], servo, belief=HELD, free_delay=False)
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
