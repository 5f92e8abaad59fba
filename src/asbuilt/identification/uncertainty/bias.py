"""Bias of estimates by effects that the model lacks, noise of positions, and driving friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.errors import UsageError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.scaled import Scaled

TOO_MUCH = 0.4
"""Bias in standard errors from which 95 % intervals hold less than 93 %."""


@dataclass(frozen=True, slots=True, eq=False)
class OmittedBias:
    """Hold the bias of base parameters and its second moment, which adds to covariances.

    A bias b with covariance V has `b b^T + V`. An estimate that is not corrected for a known bias
    has the root of the sum of squares of bias and standard error as its error (Phillips, Eberhardt
    and Parry, J. Research NIST 102, 1997; JCGM 100:2008, F.2.4.5).

    Parameters
    ----------
    bias, covariance
        Bias (p,) and second moment (p, p) of the estimate, such as a regularised one.
    free_bias, free_covariance
        Bias and covariance of weighted least squares.
    effects
        The effects, as text.
    """

    bias: Array
    covariance: Array
    free_bias: Array
    free_covariance: Array
    effects: str

    @property
    def sentence(self) -> str:
        """A note that names the effects, empty if all are in the model."""
        if not self.effects:
            return ""
        return f"Standard errors include the bias by what the model may lack: {self.effects}."

    def with_further(self, other: OmittedBias) -> OmittedBias:
        """Return the bias with another one, independent of it."""
        return OmittedBias(
            bias=self.bias + other.bias,
            covariance=self.covariance + other.covariance,
            free_bias=self.free_bias + other.free_bias,
            free_covariance=self.free_covariance + other.free_covariance,
            effects="; ".join(filter(None, (self.effects, other.effects))),
        )


def shrink_effects(effects: Array, covariance: Array, size: Array) -> tuple[Array, Array]:
    """Return mean (m,) and covariance (m, m) of effects of a usual size (m,).

    Effects are normal around zero with that standard deviation: `T (V + T)^-1 g` and `V - V (V +
    T)^-1 V` for the estimates g with covariance V (Efron and Morris, J. American Statistical
    Association 70, 1975).

    >>> mean, spread = shrink_effects(np.array([2.0]), np.array([[1.0]]), np.array([1.0]))
    >>> mean.round(12).tolist(), spread.round(12).tolist()
    ([1.0], [[0.5]])
    """
    T = np.diag(size**2)
    gain = covariance @ Scaled(covariance + T).pseudo_inverse
    # What is taken off is T (V + T)^-1's complement: an effect far beyond its error stays whole.
    spread = covariance - gain @ covariance
    return np.asarray(effects - gain @ effects), np.asarray(0.5 * (spread + spread.T))


def derive_estimate_moves(information: SquareRootInformation, estimate: Estimate) -> Array:
    """Return how an estimate moves (p, p) where weighted least squares moves.

    An estimate with inverse root S moves by `S S^T W^T W b` where weighted least squares moves by
    b: regularisation holds part of it back.
    """
    seen = (estimate.information or information).stacked(estimate.weights)[:-1, :-1]
    root = estimate.solution.inverse_root
    return root @ (seen @ root).T @ seen


def position_noise_bias(
    result: IdentificationResult, training: Sequence[Samples], noise: Sequence[Array]
) -> Array:
    """Return the expected bias of each base parameter (p,).

    `noise` are the variances of the accelerations (n,) of each recording in `training`.
    """
    base = result.base
    model = result.model
    total = sum(len(samples.q) for samples in training)
    weights = result.weights**2
    normal = np.zeros((base.n_base, base.n_base))
    for samples, variance in zip(training, noise, strict=True):
        # W_k is linear in the accelerations: one unit of each joint in turn gives its derivative.
        # States of a recording over which W_k is averaged; it depends on the positions alone.
        q = samples.q[:: max(1, -(-len(samples.q) // 400))]
        still = np.zeros_like(q)
        evaluate = partial(
            observation_matrix, model, q, still, drive=base.drive, columns=base.columns
        )
        rest = evaluate(still)
        for k in np.flatnonzero(variance > 0.0):
            unit = still.copy()
            unit[:, k] = 1.0
            rows = evaluate(unit) - rest
            weighted = rows * np.tile(weights, len(q))[:, None]
            # Recordings count by their samples, whichever states they were averaged over.
            normal += variance[k] * len(samples.q) / total * (rows.T @ weighted) / len(q)
    normal *= result.n_samples
    return -result.textbook_covariance @ normal @ result.estimates


def report_position_noise(
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
    bands = [batch.parallel.cutoff if batch.parallel else cutoff for batch in training]
    # Noise of the accelerations: the integral of (2 pi f)^4 over the band is (2 pi)^4 band^5 / 5.
    noise = [
        np.array(spectrum if len(spectrum) == n else [0.0] * n) * (2.0 * np.pi) ** 4 * band**5 / 5.0
        for band, spectrum in zip(bands, densities, strict=False)
    ]
    if not np.any(noise):
        return ()
    try:
        bias = position_noise_bias(result, training, noise)
    except UsageError:
        return ()
    errors = np.sqrt(np.diag(result.covariance))
    share = np.divide(np.abs(bias), errors, out=np.zeros_like(bias), where=errors > 0.0)
    biased = np.flatnonzero(share > TOO_MUCH)
    if not biased.size:
        return ()
    # Parameters named in the message.
    worst = biased[np.argsort(-share[biased])][:3].tolist()
    named = [f"{result.base.names[k]} by {share[k]:.2g}" for k in worst]
    return (
        Finding(
            "position_noise_bias",
            "warning",
            f"Noise of the positions biases {biased.size} of {len(bias)} parameters by more than"
            f" {TOO_MUCH:g} standard errors ({join_names(named)} standard errors): their"
            " intervals are too narrow",
            Cure("lower the cutoff, log positions with finer steps"),
        ),
    )


def doubt_driving_friction(
    information: SquareRootInformation, estimate: Estimate
) -> OmittedBias | None:
    """Return what one share of the load for both ways of driving lends the parameters, if any.

    Friction `a |load| sign(qd)` where the motor drives and `b |load| sign(qd)` where the load does
    is `(a + b)/2 |load| sign(qd) + (a - b)/2 load`: load friction, and a factor on the load, which
    bodies and a torque gain have as well. No log has more of a - b. As neither way friction drives,
    `|a - b| <= a + b = 2 Fl`: uniform within, with the standard deviation `Fl / sqrt(3)` of the
    factor at each joint. The rows of joint k then lack `W_k beta`, W of the bodies alone.
    """
    base = information.base
    links = base.columns < 10 * base.n_links
    shares = []
    columns = []
    for k, (support, factor) in enumerate(
        zip(information.support, information.joint_factors, strict=True)
    ):
        place = [j for j in support.tolist() if base.names[j] == f"Fl{k + 1}"]
        if place and estimate.beta[place[0]] > 0.0:
            load = np.where(links[support], estimate.beta[support], 0.0)
            shares.append((k, float(estimate.beta[place[0]])))
            columns.append((k, support, factor[:, :-1].T @ (factor[:, :-1] @ load)))
    if not shares:
        return None
    spread = np.array([share for _, share in shares]) / np.sqrt(3.0)

    def follow(weights: Array) -> Array:
        """Return how weighted least squares moves (p, joints) per factor on the load."""
        root = information.stacked(weights)[:, :-1]
        sides = np.zeros((base.n_base, len(columns)))
        for side, (k, support, score) in zip(sides.T, columns, strict=True):
            side[support] = weights[k] ** 2 * score
        return Scaled(root.T @ root).solve(sides)

    moves = derive_estimate_moves(information, estimate) @ follow(estimate.weights)
    plain = fit_least_squares(information, weights="joint", prior=estimate.beta)
    free = follow(plain.weights)
    names = [f"{information.joint_names[k]} ({100.0 * share:.1f} %)" for k, share in shares]
    none = np.zeros(base.n_base)
    return OmittedBias(
        bias=none,
        covariance=(moves * spread**2) @ moves.T,
        free_bias=none,
        free_covariance=(free * spread**2) @ free.T,
        effects="another friction where the load drives the motor, which is confounded with a"
        f" torque gain: at most the load friction, of {join_names(names, 4)}",
    )
