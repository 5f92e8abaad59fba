"""An identified robot let go: where its own dynamics carry it, and what becomes of its energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import gravity_torque, kinetic_energy, potential_energy
from asbuilt.errors import InertiaError, UsageError
from asbuilt.excitation.limits import MotionBounds
from asbuilt.experiment.virtual.drive_train import PositionController
from asbuilt.experiment.virtual.physics import Physics

Release = Literal["drop", "step", "free"]

STEP = 0.2
"""How far a step moves each joint [rad]; a quarter as many metres where it slides."""
STEP_CONTROLLER = PositionController(bandwidth=3.0, feedforward="gravity")
"""The controller of a step: gravity and a pole pair at 3 Hz, according to the model itself."""
SPEED = 0.3
"""Speed at which a free motion starts, as a fraction of each joint's velocity limit."""
TIMESTEP = 5e-4
"""Step of the integrator [s]."""
LOGGED = 2
"""Every how many steps of the integrator the motion is kept."""
RUNAWAY = 1e4
"""Joint velocity [rad/s or m/s] at which a simulation has broken down."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeMotion:
    """Hold a motion that nobody controls, and its energies [J], each (N,).

    States and torques are (N, n), `t` (N,).

    `kinetic` counts rotors too, `potential` is zero where the motion starts, `work` is what the
    drives have put in, `dissipated` what friction has taken out.
    """

    model: RobotModel
    release: Release
    t: Array
    q: Array
    qd: Array
    tau: Array
    kinetic: Array
    potential: Array
    work: Array
    dissipated: Array

    @property
    def total(self) -> Array:
        """Kinetic and potential energy, shape (N,)."""
        return self.kinetic + self.potential

    @property
    def imbalance(self) -> float:
        """Largest energy that came from nowhere or got lost, in parts of the energy that was turned
        over.

        The motion is MuJoCo's, the energies are those of asbuilt's equations, so this compares the
        two and the integrator.
        """
        missing = self.total - self.total[0] - self.work + self.dissipated
        turnover = np.ptp(self.kinetic) + np.ptp(self.potential)
        return float(
            np.max(np.abs(missing)) / max(turnover, np.max(self.kinetic), np.finfo(float).tiny)
        )


def run_free(
    model: RobotModel,
    release: Release = "drop",
    *,
    duration: float = 3.0,
    start: ArrayLike | None = None,
    speed: ArrayLike | None = None,
) -> FreeMotion:
    """Let a robot go in the physics engine, with the armature and friction that its description
    gives, and without joint stops.

    `drop` releases it at rest with drives that give nothing; `free` also takes the friction away
    and starts at 0.3 of the speed limits, so that the energy must stay; `step` commands 0.2 rad
    more (0.05 m) from a controller that knows the gravity and mass matrix of this model, and its
    torque limits, but no friction. `start` (n,) is the pose, by default the one in which gravity
    pulls hardest out of many; `speed` (n,) the velocity.

    Raises
    ------
    UsageError
        If pose or speed do not fit the robot, or there is no such release.
    InertiaError
        If the mass matrix is not positive definite on the way, as it may be where inertias were
        identified without constraints.

    Examples
    --------
    >>> from asbuilt.description.catalogue import bundled_robot
    >>> run_free(bundled_robot("two-link"), "free", duration=0.5).imbalance < 1e-6
    True
    """
    if release not in get_args(Release):
        raise UsageError(
            f"there is no release {release!r}; there are {', '.join(get_args(Release))}"
        )
    if not (np.isfinite(duration) and duration >= 2 * TIMESTEP * LOGGED):
        raise UsageError(f"the duration must be a positive number of seconds, got {duration}")
    further = sorted({key for joint in model.joints for key in joint.drive.terms})
    if further:
        raise UsageError(
            f"the drives of {model.name} have {', '.join(further)}, which the engine does not know;"
            " its free motion would be another robot's"
        )
    n = model.n_joints
    armature, viscous, coulomb, offset = (
        np.array([getattr(joint.drive, name) or 0.0 for joint in model.joints])
        for name in ("armature", "viscous", "coulomb", "offset")
    )
    if release == "free":
        viscous, coulomb, offset = np.zeros((3, n))
    pose = _state(start, n, "start") if start is not None else heaviest_pose(model)
    rates = SPEED * MotionBounds.assumed(model).velocity if release == "free" else np.zeros(n)
    rates = rates if speed is None else _state(speed, n, "speed")
    physics = Physics(model, armature=armature, viscous=viscous, coulomb=coulomb, timestep=TIMESTEP)
    samples = round(duration / (TIMESTEP * LOGGED)) + 1
    t: Array = np.arange(samples, dtype=np.float64) * TIMESTEP * LOGGED
    q, qd, tau = np.empty((3, samples, n))
    goal, limit = (
        pose + _step(model, pose),
        np.array([joint.limits.torque for joint in model.joints]),
    )
    physics.start(pose, rates)
    with physics.quiet():
        for k in range(samples):
            q[k], qd[k] = physics.state
            if not np.all(np.abs(qd[k]) < RUNAWAY):
                raise InertiaError(
                    f"{model.name} runs away at t = {t[k]:.3g} s: its mass matrix is not positive"
                    " definite there; identify physically consistent inertias, or give its joints"
                    " an armature"
                )
            tau[k] = (
                np.clip(_pull(model, armature, q[k], qd[k], goal), -limit, limit)
                if release == "step"
                else 0.0
            )
            physics.advance(tau[k] - offset, LOGGED)
    ones = np.ones((samples, 1))
    _, friction = physics.accelerations(
        q, qd, tau - offset, coulomb=coulomb * ones, viscous=viscous * ones
    )
    potential = potential_energy(model, q)
    return FreeMotion(
        model=model,
        release=release,
        t=t,
        q=q,
        qd=qd,
        tau=tau,
        kinetic=kinetic_energy(model, q, qd) + 0.5 * qd**2 @ armature,
        potential=potential - potential[0],
        work=np.concatenate([[0.0], np.cumsum(np.sum(tau[:-1] * np.diff(q, axis=0), axis=1))]),
        dissipated=_integral(np.sum((friction + offset) * qd, axis=1), t),
    )


def heaviest_pose(model: RobotModel) -> Array:
    """Return, out of 512 poses within the limits, the one with the largest gravity torque for its
    joints' range, shape (n,).
    """
    bounds = MotionBounds.assumed(model)
    poses = np.random.default_rng(0).uniform(bounds.lower, bounds.upper, (512, model.n_joints))
    poses = np.vstack([0.5 * (bounds.lower + bounds.upper), poses])
    return np.array(poses[int(np.argmax(np.linalg.norm(gravity_torque(model, poses), axis=1)))])


def _pull(model: RobotModel, armature: Array, q: Array, qd: Array, goal: Array) -> Array:
    """Return the torque of the step's controller, shape (n,)."""
    stiffness, lead = STEP_CONTROLLER.gains(model, armature, q[None])
    return np.asarray(gravity_torque(model, q) + stiffness[0] @ (goal - q - lead * qd))


def _step(model: RobotModel, pose: Array) -> Array:
    """Return a step of every joint towards the middle of its range, shape (n,)."""
    bounds = MotionBounds.assumed(model)
    size = np.array([STEP if joint.is_revolute else STEP / 4 for joint in model.joints])
    return np.where(pose < 0.5 * (bounds.lower + bounds.upper), size, -size)


def _state(values: ArrayLike, n: int, what: str) -> Array:
    state = np.asarray(values, dtype=np.float64)
    if state.shape != (n,) or not np.all(np.isfinite(state)):
        raise UsageError(
            f"{what} must be {n} finite numbers, one per joint, got {np.asarray(values).tolist()}"
        )
    return state


def _integral(power: Array, t: Array) -> Array:
    """Return the running integral by the trapezoidal rule, shape (N,)."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(t))])
