"""Simulation of windows by MuJoCo, an engine independent of asbuilt's own dynamics."""

from __future__ import annotations

import os
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics import drive_torque, inverse_dynamics
from asbuilt.experiment.virtual.physics import Physics, import_mujoco
from asbuilt.identification.trajectories.simulated_robot import SimulatedRobot
from asbuilt.identification.trajectories.stepping import SLOWEST
from asbuilt.identification.trajectories.windows import Windows

AT_JOINTS = ("armature", "viscous", "coulomb", "offset")
"""Drive terms that MuJoCo's joints have, and a constant torque."""
AT_MOTORS = ("motor_armature", "motor_viscous", "motor_coulomb")
"""Drive terms that a fixed tendon over the joints of a motor has."""
DIVERGED = 1e4
"""Joint velocity [rad/s or m/s] from which a simulation counts as diverged."""


def simulate_windows(robot: SimulatedRobot, windows: Windows) -> Array:
    """Simulate windows from the measured state at their start.

    Rigid bodies, armature, viscous and dry friction and the position servo are MuJoCo's, with
    implicit damping. Terms that MuJoCo lacks are evaluated at each step: what opposes the motion
    acts as dry friction, so that it holds the joint at rest too, the rest as a torque. A robot
    whose steps are `centred` starts with the velocity half a step before. Feet touch the `ground`
    of the windows.

    Returns
    -------
    Array
        Positions at the samples of each window, shape (W, L, n); NaN after a divergence.

    Raises
    ------
    MissingExtraError
        If MuJoCo is not installed.
    InertiaError
        If the mass matrix of the robot is not positive definite.
    """
    engine = _Engine(robot, windows)
    simulate = engine.in_threads if engine.native else engine.in_step
    with engine.physics.quiet():
        if robot.step:
            _, after = simulate(windows, 1)
            before = windows.start_qd - 0.5 * (after[:, 0] - windows.start_qd)
            windows = replace(windows, start_qd=np.where(np.isfinite(before), before, 0.0))
        q, qd = simulate(windows, windows.n_steps)
    every = windows.divisions
    lost = np.maximum.accumulate(~np.all(np.isfinite(q) & (np.abs(qd) < DIVERGED), axis=2), axis=1)
    q[lost] = np.nan
    return np.concatenate([windows.start_q[:, None], q[:, every - 1 :: every]], axis=1)


class _Engine:
    """A compiled robot with its servo and drive terms."""

    def __init__(self, robot: SimulatedRobot, windows: Windows) -> None:
        self.mujoco = import_mujoco("a rollout")
        step = windows.step
        ground = windows.ground
        self.robot = robot
        armature, viscous, self.friction, self.offset = map(robot.value_of, AT_JOINTS)
        self.others = robot.drive.without(*AT_JOINTS, *AT_MOTORS)
        self.other_values = robot.values_of(*self.others.keys)
        self.proportional = robot.servo is None or robot.servo.proportional
        self.native = (
            self.proportional and not np.any(self.other_values) and not np.any(self.friction < 0.0)
        )

        def extend(spec: Any) -> None:
            for k in np.flatnonzero(np.any(robot.model.motor_shares, axis=1)):
                _add_motor(spec, robot, int(k))
            if robot.servo is not None:
                _add_servo(self.mujoco, spec, robot)
            if ground is not None:
                ground.add_to(self.mujoco, spec, robot.model, step)

        self.physics = Physics(
            robot.model,
            armature=armature,
            viscous=viscous,
            coulomb=np.maximum(self.friction, 0.0),
            timestep=step,
            extend=extend,
        )
        self.compiled = self.physics.compiled
        self.order = self.physics.order
        self.every = self.physics.every
        if robot.step:
            self._take_away_what_steps_add()
        option = self.compiled.opt
        bits = self.mujoco.mjtDisableBit
        option.timestep = step
        option.integrator = self.mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.disableflags &= ~int(bits.mjDSBL_ACTUATION | bits.mjDSBL_CONTACT)
        option.cone = self.mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = 10.0
        self.floors = np.zeros((windows.n_windows, 0))
        if ground is not None:
            self.floors = ground.places(robot.model).reshape(windows.n_windows, -1)
        option.disableflags |= int(bits.mjDSBL_AUTORESET)

    def _take_away_what_steps_add(self) -> None:
        """Lower armatures by half a step of damping, as far as there are any.

        With one below zero the mass matrix, which MuJoCo factors too, might not be positive.
        """
        model = self.compiled
        kd = np.zeros(self.compiled.nv)
        kd[self.order] = self.robot.stiffness[1]
        half = 0.5 * self.robot.step
        model.dof_armature -= np.clip(half * (model.dof_damping + kd), 0.0, model.dof_armature)
        model.tendon_armature -= np.clip(half * model.tendon_damping, 0.0, model.tendon_armature)

    def in_threads(self, windows: Windows, steps: int) -> tuple[Array, Array]:
        """Return positions and velocities after every step, two (W, steps, n)."""
        rollout = import_module("mujoco.rollout")
        state = self.mujoco.mjtState
        n = len(self.every)
        size = self.mujoco.mj_stateSize(self.compiled, state.mjSTATE_FULLPHYSICS)
        start = np.zeros((windows.n_windows, size))
        moved = self.robot.model.link_motion(windows.start_q, windows.start_qd)
        start[:, 1 + self.every] = moved.q
        start[:, 1 + n + self.every] = moved.qd
        forces = self._build_forces(windows.inputs(self.robot.delay, self.robot.lead)[:, :steps])
        control = np.concatenate([forces, np.repeat(self.floors[:, None], steps, axis=1)], axis=2)
        given = (state.mjSTATE_CTRL, state.mjSTATE_QFRC_APPLIED, state.mjSTATE_MOCAP_POS)
        data = [self.mujoco.MjData(self.compiled) for _ in range(os.cpu_count() or 1)]
        with rollout.Rollout(nthread=len(data)) as pool:
            spec = sum(map(int, given))
            states, _ = pool.rollout(self.compiled, data, start, control, control_spec=spec)
        return states[..., 1 + self.order], states[..., 1 + n + self.order]

    def in_step(self, windows: Windows, steps: int) -> tuple[Array, Array]:
        """Return the same, all windows step by step, with the drive terms that MuJoCo lacks."""
        forces = self._build_forces(windows.inputs(self.robot.delay, self.robot.lead))
        order = self.order
        n_controls = self.compiled.nu
        runs = [self.mujoco.MjData(self.compiled) for _ in range(windows.n_windows)]
        moved = self.robot.model.link_motion(windows.start_q, windows.start_qd)
        for run, q, qd, floors in zip(runs, moved.q, moved.qd, self.floors, strict=True):
            run.qpos[self.every] = q
            run.qvel[self.every] = qd
            run.mocap_pos[:] = floors.reshape(-1, 3)
        shape = (windows.n_windows, steps, len(order))
        positions = np.full(shape, np.nan)
        velocities = np.full(shape, np.nan)
        q = windows.start_q.copy()
        qd = windows.start_qd.copy()
        qdd = np.zeros_like(windows.start_q)
        # looked up once: a look-up in MuJoCo's memory takes as long as half a step
        arrays = [(x.ctrl, x.qfrc_applied, x.qpos, x.qvel, x.qacc) for x in runs]
        friction = self.compiled.dof_frictionloss
        step_once = self.mujoco.mj_step
        for step in range(steps):
            added, dry = self._evaluate_others(q, qd, qdd)
            applied = forces[:, step, n_controls:].copy()
            applied[:, order] -= added
            moving = np.flatnonzero(np.all(np.abs(qd) < DIVERGED, axis=1))
            for w in moving.tolist():
                control, force, position, velocity, acceleration = arrays[w]
                friction[order] = dry[w]
                control[:] = forces[w, step, :n_controls]
                if not self.proportional:
                    control[:] = self._apply_servo_limits(control, q[w], qd[w])
                force[:] = applied[w]
                step_once(self.compiled, runs[w])
                q[w] = position[order]
                qd[w] = velocity[order]
                if self.others.needs_load:
                    qdd[w] = acceleration[order]
            positions[moving, step] = q[moving]
            velocities[moving, step] = qd[moving]
        return positions, velocities

    def _apply_servo_limits(self, goal: Array, q: Array, qd: Array) -> Array:
        """Set torque limits at a speed, and return the goals (n,) outside the deadband."""
        servo = self.robot.servo
        if servo is None:
            return goal
        low, high = servo.bounds(qd)
        self.compiled.actuator_forcerange[:] = np.stack([low, high], axis=1)
        return q + servo.acting(goal - q)

    def _build_forces(self, inputs: Array) -> Array:
        """Return controls and generalised forces of every step."""
        forces = np.zeros((*inputs.shape[:2], self.compiled.nu + len(self.every)))
        applied = self.compiled.nu + self.order
        forces[..., applied] = -self.offset
        if self.robot.servo is None:
            forces[..., applied] += inputs
        else:
            forces[..., : self.compiled.nu] = inputs
        return forces

    def _evaluate_others(self, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        """Return torque and dry friction of the terms that MuJoCo lacks, two (W, n)."""
        model = self.robot.model
        sound = np.where(np.abs(qd) < DIVERGED, qd, 0.0)
        where = np.where(np.isfinite(q), q, 0.0)
        rest = np.zeros_like(q)
        load = (
            inverse_dynamics(model, where, sound, np.nan_to_num(qdd))
            if self.others.needs_load
            else None
        )
        ahead, back = (
            drive_torque(
                self.others,
                self.other_values.reshape(-1),
                where,
                sign * np.maximum(np.abs(sound), SLOWEST),
                rest,
                load=load,
                shares=model.motor_shares,
            )
            for sign in (1.0, -1.0)
        )
        odd = 0.5 * (ahead - back) + self.friction
        return 0.5 * (ahead + back) + np.minimum(odd, 0.0) * np.sign(sound), np.maximum(odd, 0.0)


def _add_motor(spec: Any, robot: SimulatedRobot, k: int) -> None:
    """Add a motor that several joints turn, as a fixed tendon."""
    armature, viscous, coulomb = (float(robot.value_of(key)[k]) for key in AT_MOTORS)
    tendon = spec.add_tendon(name=f"motor of {robot.model.joint_names[k]}")
    for name, share in zip(robot.model.joint_names, robot.model.motor_shares[k], strict=True):
        if share:
            tendon.wrap_joint(name, share)
    tendon.armature = armature
    tendon.frictionloss = max(coulomb, 0.0)
    tendon.damping[0] = viscous


def _add_servo(mujoco: Any, spec: Any, robot: SimulatedRobot) -> None:
    """Add the position actuators of a servo."""
    for name, kp, kd, limit in zip(robot.model.joint_names, *robot.stiffness, strict=True):
        actuator = spec.add_actuator(
            name=f"servo of {name}",
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        )
        actuator.gainprm[0] = kp
        actuator.biasprm[:3] = [0.0, -kp, -kd]
        if np.isfinite(limit):
            actuator.forcelimited = True
            actuator.forcerange = [-limit, limit]
