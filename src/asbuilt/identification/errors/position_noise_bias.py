"""Bias of the estimates by noise of the positions: errors in the variables of the regression.

Noise e of the accelerations makes W + sum_k e_k W_k of the regressor W, with W_k = dW / dqdd_k. The
normal matrix grows by D = sum_k var(e_k) sum W_k^T S^-1 W_k on average, whatever the torque, and
the estimate loses (W^T S^-1 W)^-1 D beta: inertias shrink (Fuller, Measurement Error Models, 1987,
section 1.1). Standard errors do not contain that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, joined
from asbuilt.identification.result.result import IdentificationResult

TOO_MUCH = 0.4
"""Bias in standard errors from which 95 % intervals hold less than 93 %."""


def acceleration_noise(density: Array, band: float) -> Array:
    """Return the variance of the accelerations (n,) below `band` [Hz] by noise of the positions.

    `density` (n,) is the spectrum of the noise [rad^2/Hz]; the integral of (2 pi f)^4 over the band
    is (2 pi)^4 band^5 / 5.
    """
    return np.asarray(density * (2.0 * np.pi) ** 4 * band**5 / 5.0, dtype=np.float64)


def position_noise_bias(
    result: IdentificationResult, training: Sequence[Samples], noise: Sequence[Array]
) -> Array:
    """Return the expected bias of each base parameter (p,).

    `noise` are the variances of the accelerations (n,) of each recording in `training`.
    """
    base, model = result.base, result.model
    total = sum(len(samples.q) for samples in training)
    weights = 1.0 / np.maximum(result.sigma, np.finfo(np.float64).tiny) ** 2
    normal = np.zeros((base.n_base, base.n_base))
    for samples, variance in zip(training, noise, strict=True):
        # States of a recording over which W_k is averaged; it depends on the positions alone.
        q = samples.q[:: max(1, -(-len(samples.q) // 400))]
        still = np.zeros_like(q)
        rest = observation_matrix(model, q, still, still, drive=base.drive, columns=base.columns)
        for k in np.flatnonzero(variance > 0.0):
            unit = still.copy()
            unit[:, k] = 1.0
            rows = (
                observation_matrix(model, q, still, unit, drive=base.drive, columns=base.columns)
                - rest
            )
            weighted = rows * np.tile(weights, len(q))[:, None]
            normal += variance[k] * len(samples.q) / total * (rows.T @ weighted) / len(q)
    values = np.array([parameter.estimate for parameter in result.parameters])
    return np.asarray(
        -result.textbook_covariance @ (result.n_samples * normal) @ values, dtype=np.float64
    )


def position_noise_findings(
    result: IdentificationResult,
    training: Sequence[Samples],
    densities: Sequence[Sequence[float]],
    cutoff: float | None,
) -> tuple[Finding, ...]:
    """Find estimates that noise of the positions biases beyond their standard errors.

    `densities` are the spectra of the noise [rad^2/Hz] of each recording, or nothing.
    """
    n = result.model.n_joints
    if cutoff is None or len(densities) < len(training):
        return ()
    noise = [
        acceleration_noise(np.array(each), samples.parallel.cutoff if samples.parallel else cutoff)
        if len(each) == n
        else np.zeros(n)
        for samples, each in zip(training, densities, strict=False)
    ]
    if not np.any(noise):
        return ()
    try:
        bias = position_noise_bias(result, training, noise)
    except UsageError:
        return ()
    errors = np.sqrt(np.diag(result.covariance))
    share = np.divide(np.abs(bias), errors, out=np.zeros_like(bias), where=errors > 0.0)
    found = np.flatnonzero(share > TOO_MUCH)
    if not found.size:
        return ()
    # Parameters named in the message.
    worst = found[np.argsort(-share[found])][:3]
    named = [f"{result.base.names[k]} by {share[k]:.2g}" for k in worst.tolist()]
    return (
        Finding(
            "position_noise_bias",
            "warning",
            f"Noise of the positions biases {found.size} of {len(bias)} parameters by more than"
            f" {TOO_MUCH:g} standard errors ({joined(named)} standard errors): their intervals are"
            " too narrow",
            Cure("lower the cutoff, log positions with finer steps"),
        ),
    )
