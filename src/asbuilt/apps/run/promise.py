"""The torque error that a model promises on a motion before it is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt import IdentificationResult
from asbuilt.apps.run.purpose import States, evaluate_columns
from asbuilt.arrays import Array

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
        Factors (n,) by which earlier tests found more than was promised; at least 1.
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


def promise_error(
    result: IdentificationResult, states: States, widening: Array | None = None
) -> Promise:
    """Return the error that a result promises on states.

    `E e_k^2 = sigma_k^2 + mean_s Y_sk C Y_sk^T`: residual and parameters are independent, for the
    residual is that of other samples. The residual is at least the RMS of training, which rare
    large errors, such as stick and slip, raise above a robust standard deviation.
    """
    columns = evaluate_columns(result, states)
    covariance = np.array(result.covariance)
    variance = np.einsum("skp,pr,skr->k", columns, covariance, columns) / len(columns)
    torque = np.sqrt(np.mean((columns @ result.estimates) ** 2, axis=0))
    sigma = np.where(np.isfinite(result.sigma), result.sigma, 0.0)
    noise = np.fmax(sigma, np.nan_to_num(result.train.rms))
    usual = np.ones(len(sigma)) if widening is None else widening
    return Promise(noise, np.sqrt(np.maximum(variance, 0.0)), torque, usual)


def widen_promises(tests: Sequence[tuple[Promise, Array]]) -> Array | None:
    """Return the factor (n,) by which the last tests found larger errors than were promised.

    Root mean square of found over promised, at least 1; promises count without their own widening.
    """
    last = tests[-TESTS_COUNTED:]
    if not last:
        return None
    ratios = [
        found / np.maximum(np.hypot(promise.noise, promise.uncertain), np.finfo(float).tiny)
        for promise, found in last
    ]
    return np.asarray(np.maximum(1.0, np.sqrt(np.mean(np.square(ratios), axis=0))))


def _relate(errors: Array, torques: Array) -> float:
    size = float(np.linalg.norm(torques))
    return float(np.linalg.norm(errors)) / size if size > 0.0 else float("inf")
