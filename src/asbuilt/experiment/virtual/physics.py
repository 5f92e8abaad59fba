"""Physics of a robot by MuJoCo, an engine independent of asbuilt's own dynamics."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices
from asbuilt.description.formats.compiled_mjcf import collect_warnings
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import DriveValues, RobotModel
from asbuilt.description.rotation import quaternion_from_rotation, rotation_from_rpy
from asbuilt.dynamics.kinematics import draw_postures
from asbuilt.dynamics.newton_euler import mass_matrix
from asbuilt.errors import InertiaError, MissingExtraError

_AXES = rotation_from_rpy([0.3, 0.2, 0.1])
PLACEHOLDER = LinkInertia.from_com(1.0, [0.1, 0.2, 0.3], _AXES @ np.diag([2.0, 3.0, 4.0]) @ _AXES.T)
"""Inertia compiled in place of an inconsistent one, then overwritten; its axes are general."""


@dataclass(frozen=True, slots=True)
class Stiffness:
    """Hold how stiff the constraints of MuJoCo are, and which steps are stable."""

    friction_impedance: float = 0.9999
    """Share of the force that stops a joint which MuJoCo applies as dry friction; 1 is rigid."""
    friction_time: float = 0.002
    """Time constant of a joint that dry friction stops [s]."""
    rigid: float = 1e-4
    """Share of MuJoCo's softness that couplings of joints keep: accelerations to 1e-4; dry friction
    of the joint that is followed, which shares it, needs no less."""
    singular: float = 1e-12
    """Ratio of the eigenvalues of a mass matrix below which it is singular."""
    stable: float = 2.0
    """Largest product of step and decay rate; fourth-order Runge-Kutta is stable up to 2.79."""


STIFFNESS = Stiffness()


def import_mujoco(purpose: str = "a virtual robot") -> ModuleType:
    """Return MuJoCo, or raise MissingExtraError with the way to install it."""
    try:
        return import_module("mujoco")
    except ImportError:
        raise MissingExtraError("mujoco", "sim", purpose) from None


class Physics:
    """Simulate a robot in MuJoCo: rigid bodies, armature, viscous and dry friction, joint torques.

    There are no contacts and joint stops. Any inertia is accepted, also a physically inconsistent
    one, as long as the mass matrix is positive definite.

    Parameters
    ----------
    model
        The robot.
    armature, viscous, coulomb
        Drive parameters in place of the description's, one number or (n,).
    timestep
        Step of the integrator [s], fourth-order Runge-Kutta, divided further where viscous
        friction decays faster.
    springs
        Whether described springs and cylinders act.
    extend
        Called with MuJoCo's `MjSpec` of the robot before it is compiled, to add actuators or
        tendons.

    Raises
    ------
    MissingExtraError
        If MuJoCo is not installed.
    InertiaError
        If a massless link has a first moment, or the mass matrix is singular.
    """

    def __init__(
        self,
        model: RobotModel,
        *,
        armature: ArrayLike = 0.0,
        viscous: ArrayLike = 0.0,
        coulomb: ArrayLike = 0.0,
        timestep: float = 1e-3,
        springs: bool = False,
        extend: Callable[[Any], None] | None = None,
    ) -> None:
        self._mujoco = import_mujoco()
        self.model = model = model.with_rotors
        n = model.n_joints
        bare = replace(
            model,
            joints=tuple(
                replace(joint, drive=DriveValues(terms=joint.drive.terms if springs else {}))
                for joint in model.joints
            ),
            links=tuple(
                (
                    link
                    if link.inertia.is_consistent and link.inertia.mass > 0
                    else replace(link, inertia=PLACEHOLDER)
                )
                for link in model.links
            ),
        )
        spec = self._mujoco.MjSpec.from_string(format_mjcf(bare, actuators=False, shapes=False))
        if extend is not None:
            extend(spec)
        self.compiled: Any = spec.compile()
        self.compiled.opt.timestep = timestep
        self.compiled.opt.disableflags |= int(
            self._mujoco.mjtDisableBit.mjDSBL_LIMIT | self._mujoco.mjtDisableBit.mjDSBL_CONTACT
        )
        self.compiled.opt.disableflags |= int(self._mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        self.compiled.jnt_actfrclimited[:] = 0
        ids = self._mujoco.mj_name2id
        self._every = np.array(
            [
                ids(self.compiled, self._mujoco.mjtObj.mjOBJ_JOINT, joint.name)
                for joint in model.moving_joints
            ]
        )
        self._order = self._every[:n]
        self.compiled.eq_solimp[:] = [
            STIFFNESS.friction_impedance,
            STIFFNESS.friction_impedance,
            0.001,
            0.5,
            2.0,
        ]
        self.compiled.eq_solref[:] = [max(STIFFNESS.friction_time, 2 * timestep), 1.0]
        self._bodies = [
            ids(self.compiled, self._mujoco.mjtObj.mjOBJ_BODY, name) for name in model.link_names
        ]
        self._take_inertias(bare)
        self.compiled.dof_armature[self._order] = np.broadcast_to(
            np.asarray(armature, dtype=np.float64), (n,)
        )
        self.rub(
            np.broadcast_to(np.asarray(coulomb, dtype=np.float64), (n,)),
            np.broadcast_to(np.asarray(viscous, dtype=np.float64), (n,)),
        )
        self.compiled.dof_solimp[:] = [
            STIFFNESS.friction_impedance,
            STIFFNESS.friction_impedance,
            0.001,
            0.5,
            2.0,
        ]
        self.compiled.dof_solref[:] = [max(STIFFNESS.friction_time, 2 * timestep), 1.0]
        self._parts = max(
            1,
            math.ceil(
                timestep * self._fastest_decay(self._sound_mass_matrices()) / STIFFNESS.stable
            ),
        )
        self.compiled.opt.timestep = timestep / self._parts
        self.data: Any = self._mujoco.MjData(self.compiled)
        with self.quiet():
            self._mujoco.mj_setConst(self.compiled, self.data)
        leading = np.flatnonzero(np.any(model.link_shares[n:] != 0.0, axis=0))
        coupled = [*range(n, model.n_links), *leading]
        in_loops = self.compiled.eq_type == self._mujoco.mjtEq.mjEQ_CONNECT
        in_loops |= self.compiled.eq_type == self._mujoco.mjtEq.mjEQ_WELD
        held = {*self.compiled.eq_obj1id[in_loops], *self.compiled.eq_obj2id[in_loops]}
        self.compiled.body_invweight0[sorted(held)] *= STIFFNESS.rigid
        by_tendon = self.compiled.eq_type == self._mujoco.mjtEq.mjEQ_TENDON
        self.compiled.tendon_invweight0[self.compiled.eq_obj1id[by_tendon]] *= STIFFNESS.rigid
        self.compiled.dof_invweight0[self._every[coupled]] *= STIFFNESS.rigid

    def _take_inertias(self, compiled: RobotModel) -> None:
        for k, link, placeholder in zip(
            self._bodies, self.model.links, compiled.links, strict=True
        ):
            if placeholder.inertia is not PLACEHOLDER:
                continue
            inertia = link.inertia
            if inertia.mass == 0.0 and np.any(inertia.first_moment != 0.0):
                raise InertiaError(
                    f"{self.model.name}: link {link.name!r} has no mass but the first moment"
                    f" {inertia.first_moment.tolist()} kg m; an engine places mass at a centre of"
                    " mass, so give the link some mass"
                )
            moments, axes = np.linalg.eigh(inertia.inertia_about_com)
            if np.linalg.det(axes) < 0:
                axes[:, 0] *= -1.0
            self.compiled.body_mass[k] = inertia.mass
            self.compiled.body_ipos[k] = inertia.com
            self.compiled.body_iquat[k] = quaternion_from_rotation(axes)
            self.compiled.body_inertia[k] = moments

    def _sound_mass_matrices(self) -> Array:
        """Return the mass matrices of some random poses (8, n, n), armature included.

        Raises InertiaError where one is singular.
        """
        q = draw_postures(self.model, np.random.default_rng(0), 8)
        masses: Array = mass_matrix(self.model, q) + np.diag(
            self.compiled.dof_armature[self._order]
        )
        for M in masses:
            eigenvalues, vectors = np.linalg.eigh(M)
            if eigenvalues[0] <= STIFFNESS.singular * eigenvalues[-1]:
                worst = self.model.joint_names[int(np.argmax(np.abs(vectors[:, 0])))]
                raise InertiaError(
                    f"the mass matrix of {self.model.name} is not positive definite (smallest"
                    f" eigenvalue {eigenvalues[0]:.3g}, mostly joint {worst!r}), so torques do not"
                    " determine how it moves; check the inertias, or give the joint an armature"
                )
        return masses

    def _fastest_decay(self, masses: Array) -> float:
        """Return the largest eigenvalue of M^-1 D [1/s], the fastest decay by viscous friction."""
        root = np.sqrt(np.maximum(self.compiled.dof_damping[self._order], 0.0))
        return float(
            np.linalg.eigvalsh(root[:, None] * np.linalg.solve(masses, np.diag(root))).max()
        )

    def inverse_dynamics(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Return MuJoCo's torque for states (N, n).

        Rigid bodies, armature and viscous friction, without dry friction; shape (N, n).
        """
        states = [np.atleast_2d(np.asarray(x, dtype=np.float64)) for x in (q, qd, qdd)]
        torque = np.empty(states[0].shape)
        flags = self.compiled.opt.disableflags
        self.compiled.opt.disableflags |= int(self._mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        data, every = self.data, self._every
        moved = self.model.link_motion(*states)
        for k in range(len(torque)):
            data.qpos[every], data.qvel[every] = moved.q[k], moved.qd[k]
            data.qacc[every] = moved.qdd[k]
            self._mujoco.mj_inverse(self.compiled, data)
            torque[k] = data.qfrc_inverse[every] @ moved.by_sample[k % len(moved.by_sample)]
        self.compiled.opt.disableflags = flags
        return torque

    def accelerations(
        self, q: Array, qd: Array, tau: Array, *, coulomb: Array, viscous: Array
    ) -> tuple[Array, Array]:
        """Return joint accelerations and friction torques, two (N, n).

        States, torques and the friction of each sample are (N, n). Friction is what the drive has
        to overcome: `tau = rigid bodies + armature qdd + friction`.
        """
        acceleration, friction = np.empty(q.shape), np.empty(q.shape)
        data, order, moved = self.data, self._order, self.model.link_motion(q, qd)
        for k in range(len(q)):
            data.qpos[self._every], data.qvel[self._every] = moved.q[k], moved.qd[k]
            data.qfrc_applied[order] = tau[k]
            self.rub(coulomb[k], viscous[k])
            self._mujoco.mj_forward(self.compiled, data)
            acceleration[k] = data.qacc[order]
            at_joints = (data.qfrc_spring - data.qfrc_constraint - data.qfrc_passive)[self._every]
            friction[k] = at_joints @ moved.by_sample[k % len(moved.by_sample)]
        return acceleration, friction

    @property
    def order(self) -> Indices:
        """Index of each joint's degree of freedom in the compiled model, shape (n,)."""
        return self._order

    @property
    def every(self) -> Indices:
        """Index of the degree of freedom of each link's joint in the compiled model (n_links,)."""
        return self._every

    def start(self, q: ArrayLike, qd: ArrayLike) -> None:
        """Put the robot into a state (n,), at time 0 and without memory of earlier motion."""
        self._mujoco.mj_resetData(self.compiled, self.data)
        moved = self.model.link_motion(*(np.array([x], dtype=np.float64) for x in (q, qd)))
        self.data.qpos[self._every], self.data.qvel[self._every] = moved.q[0], moved.qd[0]

    @property
    def state(self) -> tuple[Array, Array]:
        """Joint positions and velocities of this moment, two (n,)."""
        return self.data.qpos[self._order], self.data.qvel[self._order]

    def quiet(self) -> AbstractContextManager[list[str]]:
        """Collect MuJoCo's warnings, which would otherwise go to the terminal and to a log file."""
        return collect_warnings(self._mujoco)

    def rub(self, coulomb: Array, viscous: Array) -> None:
        """Set dry [N m] and viscous [N m s/rad] friction, two (n,)."""
        self.compiled.dof_frictionloss[self._order], self.compiled.dof_damping[self._order] = (
            coulomb,
            viscous,
        )

    def advance(self, tau: Array, steps: int = 1) -> None:
        """Take time steps under constant joint torques (n,)."""
        self.data.qfrc_applied[self._order] = tau
        self._mujoco.mj_step(self.compiled, self.data, steps * self._parts)
