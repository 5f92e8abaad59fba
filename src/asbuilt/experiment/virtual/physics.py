"""Physics of a robot by MuJoCo, an engine independent of asbuilt's own dynamics."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
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


FRICTION_IMPEDANCE = 0.9999
"""Share of the force that stops a joint which MuJoCo applies as dry friction; 1 is rigid."""
FRICTION_TIME = 0.002
"""Time constant of a joint that dry friction stops [s]."""
RIGID = 1e-4
"""Share of MuJoCo's softness that couplings of joints keep: accelerations to 1e-4; dry friction
of the joint that is followed, which shares it, needs no less."""
SINGULAR = 1e-12
"""Ratio of the eigenvalues of a mass matrix below which it is singular."""
STABLE = 2.0
"""Largest product of step and decay rate; fourth-order Runge-Kutta is stable up to 2.79."""


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
        off = self._mujoco.mjtDisableBit
        self.compiled.opt.disableflags |= int(
            off.mjDSBL_LIMIT | off.mjDSBL_CONTACT | off.mjDSBL_ACTUATION
        )
        self.compiled.jnt_actfrclimited[:] = 0
        joints = [self.compiled.joint(joint.name).id for joint in model.moving_joints]
        self.every: Indices = np.array(joints)
        """Index of the degree of freedom of each link's joint in the compiled model (n_links,)."""
        self.order: Indices = self.every[:n]
        """The same of each joint, shape (n,)."""
        self._take_inertias(bare)
        self.compiled.dof_armature[self.order] = armature
        self.rub(coulomb, viscous)
        # Constraints are as stiff as dry friction: impedance at no and large violation, its shape.
        impedance = FRICTION_IMPEDANCE
        solimp = [impedance, impedance, 0.001, 0.5, 2.0]
        solref = [max(FRICTION_TIME, 2 * timestep), 1.0]
        self.compiled.eq_solimp[:] = solimp
        self.compiled.dof_solimp[:] = solimp
        self.compiled.eq_solref[:] = solref
        self.compiled.dof_solref[:] = solref
        self._parts = max(
            1,
            math.ceil(timestep * self._fastest_decay(self._sound_mass_matrices()) / STABLE),
        )
        self.compiled.opt.timestep = timestep / self._parts
        self.data: Any = self._mujoco.MjData(self.compiled)
        with self.quiet():
            self._mujoco.mj_setConst(self.compiled, self.data)
        leading = np.flatnonzero(np.any(model.link_shares[n:] != 0.0, axis=0))
        coupled = [*range(n, model.n_links), *leading]
        kinds = self._mujoco.mjtEq
        in_loops = np.isin(self.compiled.eq_type, [kinds.mjEQ_CONNECT, kinds.mjEQ_WELD])
        held = {*self.compiled.eq_obj1id[in_loops], *self.compiled.eq_obj2id[in_loops]}
        self.compiled.body_invweight0[sorted(held)] *= RIGID
        by_tendon = self.compiled.eq_type == kinds.mjEQ_TENDON
        self.compiled.tendon_invweight0[self.compiled.eq_obj1id[by_tendon]] *= RIGID
        self.compiled.dof_invweight0[self.every[coupled]] *= RIGID

    def _take_inertias(self, compiled: RobotModel) -> None:
        """Overwrite the placeholders in a compiled model by the inertias as they are."""
        for link, placeholder in zip(self.model.links, compiled.links, strict=True):
            if placeholder.inertia is not PLACEHOLDER:
                continue
            inertia = link.inertia
            if inertia.mass == 0.0 and np.any(inertia.first_moment != 0.0):
                raise InertiaError(
                    f"{self.model.name}: link {link.name!r} has no mass but the first moment"
                    f" {inertia.first_moment.tolist()} kg m; an engine places mass at a centre of"
                    " mass, so give the link some mass"
                )
            moments, axes = inertia.principal_axes
            body = self.compiled.body(link.name)
            body.mass = inertia.mass
            body.ipos = inertia.com
            body.iquat = quaternion_from_rotation(axes)
            body.inertia = moments

    def _sound_mass_matrices(self) -> Array:
        """Return the mass matrices of some random poses (8, n, n), armature included.

        Raises InertiaError where one is singular.
        """
        masses: Array = mass_matrix(
            self.model, draw_postures(self.model, np.random.default_rng(0), 8)
        ) + np.diag(self.compiled.dof_armature[self.order])
        for M in masses:
            eigenvalues, vectors = np.linalg.eigh(M)
            if eigenvalues[0] <= SINGULAR * eigenvalues[-1]:
                worst = self.model.joint_names[int(np.argmax(np.abs(vectors[:, 0])))]
                raise InertiaError(
                    f"the mass matrix of {self.model.name} is not positive definite (smallest"
                    f" eigenvalue {eigenvalues[0]:.3g}, mostly joint {worst!r}), so torques do not"
                    " determine how it moves; check the inertias, or give the joint an armature"
                )
        return masses

    def _fastest_decay(self, masses: Array) -> float:
        """Return the largest eigenvalue of M^-1 D [1/s], the fastest decay by viscous friction."""
        root = np.sqrt(np.maximum(self.compiled.dof_damping[self.order], 0.0))
        return float(
            np.linalg.eigvalsh(root[:, None] * np.linalg.solve(masses, np.diag(root))).max()
        )

    def accelerations(
        self, q: Array, qd: Array, tau: Array, *, coulomb: Array, viscous: Array
    ) -> tuple[Array, Array]:
        """Return joint accelerations and friction torques, two (N, n).

        States, torques and the friction of each sample are (N, n). Friction is what the drive has
        to overcome: `tau = rigid bodies + armature qdd + friction`.
        """
        acceleration = np.empty(q.shape)
        friction = np.empty(q.shape)
        data = self.data
        order = self.order
        moved = self.model.link_motion(q, qd)
        for k in range(len(q)):
            data.qpos[self.every] = moved.q[k]
            data.qvel[self.every] = moved.qd[k]
            data.qfrc_applied[order] = tau[k]
            self.rub(coulomb[k], viscous[k])
            self._mujoco.mj_forward(self.compiled, data)
            acceleration[k] = data.qacc[order]
            at_joints = (data.qfrc_spring - data.qfrc_constraint - data.qfrc_passive)[self.every]
            friction[k] = at_joints @ moved.by_sample[k % len(moved.by_sample)]
        return acceleration, friction

    def start(self, q: ArrayLike, qd: ArrayLike) -> None:
        """Put the robot into a state (n,), at time 0 and without memory of earlier motion."""
        self._mujoco.mj_resetData(self.compiled, self.data)
        moved = self.model.link_motion(*(np.array([x], dtype=np.float64) for x in (q, qd)))
        self.data.qpos[self.every] = moved.q[0]
        self.data.qvel[self.every] = moved.qd[0]

    @property
    def state(self) -> tuple[Array, Array]:
        """Joint positions and velocities of this moment, two (n,)."""
        return self.data.qpos[self.order], self.data.qvel[self.order]

    def quiet(self) -> AbstractContextManager[list[str]]:
        """Collect MuJoCo's warnings, which would otherwise go to the terminal and to a log file."""
        return collect_warnings(self._mujoco)

    def rub(self, coulomb: ArrayLike, viscous: ArrayLike) -> None:
        """Set dry [N m] and viscous [N m s/rad] friction, one number or (n,) each."""
        self.compiled.dof_frictionloss[self.order] = coulomb
        self.compiled.dof_damping[self.order] = viscous

    def advance(self, tau: Array, steps: int = 1) -> None:
        """Take time steps under constant joint torques (n,)."""
        self.data.qfrc_applied[self.order] = tau
        self._mujoco.mj_step(self.compiled, self.data, steps * self._parts)
