"""Elastic joints: links that lag behind their motors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.kinematics import draw_postures_within
from asbuilt.dynamics.newton_euler import inverse_dynamics, mass_matrix
from asbuilt.excitation.limits import MotionBounds
from asbuilt.findings import Cure, Finding
from asbuilt.identification.effects.effect import (
    Described,
    Effect,
    FoundEffect,
    Motion,
    Variant,
    effect,
)
from asbuilt.tables import round_significant


def elastic_columns(
    model: RobotModel,
    chi: ArrayLike,
    state: Array,
    rate: float,
    joint: int,
    *,
    load: Array | None = None,
) -> Array:
    """Return the torque of each joint per compliance of one joint, shape (N, n).

    With encoders at the motors and a stiffness K_k [N m/rad or N/m] between motor and link k, the
    link lags by `tau_k / K_k`, tau_k the torque that the spring transmits. To first order in the
    compliance `c_k = 1 / K_k` the stiff robot's torque at the logged positions lacks

        sum_k c_k column_k,   column_k = -(D_q tau_k + D_qd dtau_k/dt + D_qdd d2tau_k/dt2),

    D the derivative of all torques by position, velocity and acceleration of joint k. Friction and
    rotors are at the motors, where the logged motion is theirs. Compliances are small where their
    lag is.

    Parameters
    ----------
    model
        The robot.
    chi
        Standard parameters of its links (10 n_links,); parameters that follow are not used.
    state
        Positions, velocities and accelerations (3, N, n) without gaps.
    rate
        Samples a second; tau_k is differentiated by central differences, which lose a share
        `(2 pi f / rate)^2 / 3` at the frequency f.
    joint
        The joint, from 0.
    load
        Torque of the rigid bodies (N, n), if it is known.

    Source: Spong, Modeling and control of elastic joint robots, ASME J. Dyn. Sys. Meas. Control
    109, 1987: the slow manifold to first order in 1 / K.
    """
    links = np.asarray(chi, dtype=np.float64)[: 10 * model.n_links]
    rigid = inverse_dynamics(model, *state, parameters=links) if load is None else load
    transmitted = rigid[:, joint]
    # Differences of second order need three samples.
    if len(transmitted) < 3:
        return np.zeros_like(rigid)
    first = np.gradient(transmitted, 1.0 / rate, edge_order=2)
    # The spring lags by tau / K, so position, velocity and acceleration lag by tau's derivatives.
    lag = np.stack([transmitted, first, np.gradient(first, 1.0 / rate, edge_order=2)])
    # Largest lag [rad or m] of the central differences; their error is of its square, 1e-8.
    step = 1e-4 / max(float(np.abs(transmitted).max()), np.finfo(float).tiny)
    moved = np.zeros_like(state)
    # One directional derivative is the sum of all three partial ones, at the cost of two
    # recursions.
    moved[:, :, joint] = step * lag
    ahead, behind = (
        inverse_dynamics(model, *(state + sign * moved), parameters=links) for sign in (1.0, -1.0)
    )
    # Behind less ahead: the link lags, so that its torque is lacking with a minus.
    return np.asarray((behind - ahead) / (2.0 * step))


POSTURES = 50
"""Postures over which the inertia behind a joint is averaged."""
OFF = 0.1
"""Share of a link's torque by which the rigid model is off at the frequency that is named."""


@effect
class Elastic(Effect):
    """Let the link of a joint lag by the torque over the joint's stiffness; its size is 1 / K."""

    key = "elastic"
    title = "elastic joint, compliance"
    positive = True
    by_span = True
    units = "rad/(N m)", "m/N"

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield each joint."""
        for k in range(robot.model.n_joints):
            yield Variant(self, 1, local=False, joint=k)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the torque per compliance of the joint."""
        state = np.stack([motion.q, motion.qd, motion.qdd])
        return [
            elastic_columns(
                motion.robot.model,
                motion.robot.chi,
                state,
                motion.rate,
                variant.joint or 0,
                load=motion.torques[0],
            )
        ]

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding | None:
        """Return the stiffness, and from which frequency on the rigid model fails."""
        if found.joint is None or not found.estimate > 0.0:
            return None
        k = model.joint_names.index(found.joint)
        stiffness = 1.0 / found.estimate
        limit = rigid_limit(model, k, stiffness)
        fails = (
            f", so the rigid model is {100 * OFF:.0f} % off from"
            f" {round_significant(limit, 2)} Hz on"
        )
        unit = "N m/rad" if model.joints[k].is_revolute else "N/m"
        return Finding(
            "elastic_joint",
            "info",
            f"Not in the model: {found.joint} is elastic, about {round_significant(stiffness, 2)}"
            f" {unit}"
            f"{fails if np.isfinite(limit) else ''}",
            Cure("log a second encoder (q_link_*), which shows the stiffness, or move slower"),
            joint=found.joint,
        )


def rigid_limit(model: RobotModel, joint: int, stiffness: float) -> float:
    """Return the frequency [Hz] from which the rigid model of an elastic joint fails.

    A link of inertia M on a spring K whose other end moves at the frequency w accelerates by
    `1 / (1 - w^2 M / K)` as much: to first order its torque is the share `w^2 M / K` off. M is the
    mean over the joint's range of the description's masses, infinite where they are none.
    """
    bounds = MotionBounds.assumed(model)
    # A fixed seed: the same description has the same frequency.
    rng = np.random.default_rng(0)
    q = draw_postures_within(model, bounds.lower, bounds.upper, rng, POSTURES)
    inertia = float(np.mean(mass_matrix(model, q)[:, joint, joint]))
    # From w^2 M / K = OFF.
    return float(np.sqrt(OFF * stiffness / inertia) / (2.0 * np.pi)) if inertia > 0.0 else np.inf
