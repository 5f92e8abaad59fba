"""What a model is for: the states that matter, and the weight of parameter errors there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import asbuilt
from asbuilt import IdentificationResult, RobotModel
from asbuilt.apps.run.options import Purpose
from asbuilt.arrays import Array
from asbuilt.excitation import Motion

DRAWN_MOTIONS = 6
"""Random motions that stand for the whole range; their poses cover it, errors average over them."""
SAMPLES = 3000
"""States of all motions together; of a joint's slowest 2 %, where most errors are, these are 60."""
RANGE_SEED = 20_150_000
"""Seed of these motions, far from those of users, so that a test motion is never one of them."""


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """Hold positions, velocities and accelerations, each (N, n)."""

    q: Array
    qd: Array
    qdd: Array

    @property
    def speed(self) -> float:
        """RMS velocity of all joints together [rad/s or m/s]."""
        return float(np.sqrt(np.sum(np.mean(self.qd**2, axis=0))))

    @classmethod
    def of(cls, motions: Sequence[Motion], count: int = SAMPLES) -> States:
        """Return `count` states of motions, at equal intervals of each."""
        each = max(2, count // len(motions))
        parts = [motion.at(np.linspace(0.0, motion.duration, each)) for motion in motions]
        q, qd, qdd = (np.vstack(values) for values in zip(*parts, strict=True))
        return cls(q, qd, qdd)


def choose_states(model: RobotModel, motion: Motion | None) -> States:
    """Return the states that matter: of the user's motion, or of the robot's whole range."""
    if motion is not None:
        return States.of([motion])
    drawn = [asbuilt.random_fourier(model, RANGE_SEED + k) for k in range(DRAWN_MOTIONS)]
    return States.of(drawn)


def evaluate_columns(result: IdentificationResult, states: States) -> Array:
    """Return the base columns Y (N, n, p) of a result at states."""
    base = result.base
    model = result.model
    rows = asbuilt.observation_matrix(
        model, states.q, states.qd, states.qdd, drive=base.drive, columns=base.columns
    )
    return np.asarray(rows.reshape(len(states.q), model.n_joints, -1))


def weigh_parameters(
    result: IdentificationResult, states: States, purpose: Purpose, weights: Array
) -> Array:
    """Return A (p, p), so that `d^T A d` is what an error d of the parameters costs the purpose.

    For torque and simulators it is the squared torque error, joint k weighted by `weights` (n,):
    `A = mean_s sum_k w_k Y_sk^T Y_sk`. For a payload it is the squared torque of the load that
    would be mistaken for the error, `G d` with `G = (L^T S^-1 L)^-1 L^T S^-1 Y`, L the columns of
    a body at the last link and S the squared noise.
    """
    columns = evaluate_columns(result, states)
    if purpose != "payload":
        return np.asarray(np.einsum("skp,k,skr->pr", columns, weights, columns) / len(columns))
    model = result.model
    first = 10 * model.tool_link
    loads = asbuilt.observation_matrix(
        model, states.q, states.qd, states.qdd, columns=np.arange(first, first + 10)
    )
    weight = np.sqrt(weights) / np.where(np.isfinite(result.sigma), result.sigma, np.inf)
    weighted = loads.reshape(*columns.shape[:2], 10) * weight[:, None]
    rows = (columns * weight[:, None]).reshape(-1, columns.shape[2])
    body = weighted.reshape(-1, 10)
    mistaken = np.linalg.lstsq(body, rows, rcond=None)[0]
    torque = loads @ mistaken
    return np.asarray(torque.T @ torque / len(columns))
