"""What a model is for, and the torque error that it promises on a motion before it is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

import asbuilt
from asbuilt import IdentificationResult, RobotModel
from asbuilt.apps.run.options import Purpose
from asbuilt.arrays import Array
from asbuilt.excitation import Motion
from asbuilt.validation import Validation

FEWEST = 4
"""Samples of the slowest group of `Unexplained`; fewer make its level a matter of chance."""
TESTS_COUNTED = 2
"""Last tests that widen a promise; earlier ones were of models that knew less."""


@dataclass(frozen=True, slots=True, eq=False)
class Promise:
    """Hold the torque error that a model promises on some states.

    Parameters
    ----------
    noise, uncertain
        RMS torque error of each joint (n,) [N m or N]: what the model left unexplained in its own
        recordings, and by the errors of its parameters.
    torque
        RMS torque of each joint (n,).
    widening
        Factors (n,) by which earlier tests found more than is promised for them; at least 1.
    """

    noise: Array
    uncertain: Array
    torque: Array
    widening: Array

    @property
    def joints(self) -> Array:
        """RMS torque error of each joint (n,)."""
        return np.asarray(np.hypot(self.noise, self.uncertain) * self.widening)

    @property
    def error(self) -> float:
        """Torque error as a share of the torque, over all joints as in `TorqueMetrics`."""
        return _relate(self.joints, self.torque)

    @property
    def noise_error(self) -> float:
        """The part of `error` that more motion of the same kind does not take away."""
        return _relate(self.noise * self.widening, self.torque)


@dataclass(frozen=True, slots=True, eq=False)
class Unexplained:
    """Hold the torque that a model leaves unexplained, by how slowly a joint moves.

    What dry friction does at reversal no model of friction by velocity explains: where a joint
    creeps, errors are ten to a hundred times those of quick motion. A filter of the width `T`, the
    time between samples, sees how slowly a joint moves by `hypot(qd, T qdd)`. Errors in groups of
    equal such speed agree between motions, the mean over a motion does not.

    Parameters
    ----------
    speeds, squares
        Upper speeds and mean squared errors of the groups, of each joint; slower groups have the
        larger errors.
    interval
        The time T [s].
    """

    speeds: tuple[Array, ...]
    squares: tuple[Array, ...]
    interval: float

    @classmethod
    def of(cls, validations: Sequence[Validation]) -> Unexplained:
        """Return the unexplained torque of predictions, joint by joint.

        The groups are the slowest samples, as many again, then twice as many, and so on.
        """
        interval = float(
            np.median(np.concatenate([np.diff(validation.t) for validation in validations]))
        )
        speed = np.vstack([_measure_speed(validation, interval) for validation in validations])
        squared = np.vstack([validation.error for validation in validations]) ** 2
        groups = [_group(*columns) for columns in zip(speed.T, squared.T, strict=True)]
        speeds, squares = zip(*groups, strict=True)
        return cls(speeds, squares, interval)

    def at(self, states: States) -> Array:
        """Return the RMS torque (n,) [N m or N] that stays unexplained on states."""
        speed = np.hypot(states.qd, self.interval * states.qdd)
        means = []
        for upper, squares, moving in zip(self.speeds, self.squares, speed.T, strict=True):
            group = np.searchsorted(upper[:-1], moving)
            means.append(np.mean(squares[group]))
        return np.asarray(np.sqrt(means))


def _measure_speed(validation: Validation, interval: float) -> Array:
    """Return how fast joints move (N, n), with the change of speed in an interval [s]."""
    change = interval * np.gradient(validation.velocity, validation.t, axis=0)
    return np.asarray(np.hypot(validation.velocity, change))


def _group(speed: Array, squared: Array) -> tuple[Array, Array]:
    """Return upper speeds of groups of samples and their mean squares, which fall with speed."""
    known = np.isfinite(squared)
    order = np.argsort(speed[known])
    speed = speed[known][order]
    squared = squared[known][order]
    if not len(speed):
        return np.array([np.inf]), np.zeros(1)
    ends = [len(speed)]
    while ends[0] >= 2 * FEWEST:
        ends.insert(0, ends[0] // 2)
    sums = np.add.reduceat(squared, [0, *ends[:-1]])
    counts = np.diff([0, *ends])
    # A standard error up: the slowest groups have few samples, and of large errors.
    means = sums / counts * (1.0 + np.sqrt(2.0 / counts))
    falling = isotonic_regression(means, weights=counts, increasing=False)
    return speed[np.array(ends) - 1], np.asarray(falling.x)


def promise_error(
    result: IdentificationResult,
    states: States,
    widening: Array | None = None,
    unexplained: Unexplained | None = None,
) -> Promise:
    """Return the error that a result promises on states.

    `E e_k^2 = sigma_k^2 + mean_s Y_sk C Y_sk^T`: residual and parameters are independent, for the
    residual is that of other samples. It is the one of training at the speeds of the states, or
    without `unexplained` at those of training; its RMS has what a robust standard deviation leaves
    out, rare large errors such as stick and slip.
    """
    columns = evaluate_columns(result, states)
    covariance = np.array(result.covariance)
    variance = np.einsum("skp,pr,skr->k", columns, covariance, columns) / len(columns)
    torque = np.sqrt(np.mean((columns @ result.estimates) ** 2, axis=0))
    sigma = np.where(np.isfinite(result.sigma), result.sigma, 0.0)
    if unexplained is None:
        noise = np.fmax(sigma, np.nan_to_num(result.train.rms))
    else:
        noise = unexplained.at(states)
    usual = np.ones(len(sigma)) if widening is None else widening
    return Promise(noise, np.sqrt(np.maximum(variance, 0.0)), torque, usual)


def widen_promise(
    result: IdentificationResult,
    unexplained: Unexplained | None,
    tests: Sequence[tuple[States, Promise, Array]],
) -> Array | None:
    """Return the factor (n,) by which the last tests found more than was, and is, promised there.

    Each test has the states of a motion, what was promised before it was learned and the RMS torque
    error (n,) then found. A model that knew less promised more, and what is learned of friction at
    reversal is in the promise that a result makes now: the larger counts, without earlier factors.
    Root mean square of found over promised, at least 1.
    """
    last = tests[-TESTS_COUNTED:]
    if not last:
        return None
    squares = []
    for states, before, found in last:
        now = promise_error(result, states, unexplained=unexplained)
        promised = np.maximum(before.joints / before.widening, now.joints)
        squares.append((found / np.maximum(promised, np.finfo(float).tiny)) ** 2)
    return np.asarray(np.maximum(1.0, np.sqrt(np.mean(squares, axis=0))))


def _relate(errors: Array, torques: Array) -> float:
    size = float(np.linalg.norm(torques))
    return float(np.linalg.norm(errors)) / size if size > 0.0 else float("inf")


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
