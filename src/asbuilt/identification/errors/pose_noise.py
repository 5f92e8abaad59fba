"""Bias by noise of the pose of a free base, and the scores that take it away.

Accelerations by differences have the noise d of the pose, W = W_0 + dW with
`dW_k = sum_c P dW_k/dqdd_c d_c`. Residuals at the true parameters are noise of the torque
less `dW beta`, so that the scores have the mean `E[W_k^T e_k] = -E[dW_k^T dW_k] beta`: least
squares explain noise by bodies that are too light (Fuller, Measurement Error Models, 1987, section
2.2).
Nothing drives a base, so that its equations lose most. Where they weigh as their noise says the
bias is many standard errors, and without it they tell the most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.contact import contact_basis
from asbuilt.dynamics.regressor import observation_matrix
from asbuilt.identification.errors.expected_scores import ExpectedScores
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.square_root_information import SquareRootInformation
from asbuilt.identification.result.design_values import design_values

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples


@dataclass(frozen=True, slots=True)
class PoseNoiseRules:
    """Say how the squares of noise are averaged, and how often scores are found: own choices."""

    states: int = 400
    """States of a recording over which the squares of its noise are averaged."""
    passes: int = 5
    """Passes: each leaves the share of the bias that noise has of a direction."""
    possible: float = 2.0
    """Share of noise in what was observed of a direction, up to which chance explains that it
    exceeds 1; beyond, rows are next to zero there, and least squares say nothing of bodies."""


RULES = PoseNoiseRules()


class PoseNoise(NamedTuple):
    """Base parameters (p,) of least squares, and what noise of the pose lends them.

    `scores` is None where the noise is unknown, or rows of a direction are next to zero. `growth`
    (p,) multiplies standard errors: what takes back a bias takes random errors along.
    """

    beta: Array
    scores: ExpectedScores | None
    growth: Array


def expect_pose_noise(
    model: RobotModel,
    base: BaseParameters,
    samples: Sequence[Samples],
    information: SquareRootInformation,
) -> PoseNoise:
    """Return least squares without the scores that noise of the pose lends the parameters.

    The scores depend on the parameters, so both are found in turn, from `beta = (W^T W)^-1 W^T tau`
    on by `beta + (W^T W)^-1 N S beta` with S the mean square of the noise in W.
    """
    prior = design_values(model, base)
    estimate = fit_least_squares(information, weights="joint", prior=prior)
    uncorrected = PoseNoise(estimate.beta, None, np.ones(base.n_base))
    if not any(any(each.pose_noise) for each in samples):
        return uncorrected
    total = sum(len(each.q) for each in samples)
    shares = [len(each.q) / total * _average_noise(model, base, each) for each in samples]
    grams = np.sum(shares, axis=0)
    names = tuple(tuple(base.names[j] for j in own) for own in information.support)
    squares = np.einsum("n,npr->pr", estimate.weights**2, grams) * information.n_samples
    root = estimate.solution.inverse_root
    share, axes = np.linalg.eigh(root.T @ squares @ root)
    if np.abs(share).max() > RULES.possible:
        return uncorrected
    # No direction holds more noise than all that was observed of it.
    share = np.maximum(share, 0.0)
    kept = 1.0 / np.maximum(share, 1.0)
    along, of = root @ axes, axes.T @ np.linalg.pinv(root)
    grams = grams @ (np.eye(base.n_base) + (along * (kept - 1.0)) @ of)
    taken = sum(((kept * share) ** k for k in range(1, RULES.passes + 1)), np.zeros(len(share)))
    own, grown = (np.linalg.norm(each, axis=1) for each in (along, along * (1.0 + taken)))
    growth = np.divide(grown, own, out=np.ones(base.n_base), where=own > 0.0)
    expected: ExpectedScores | None = None
    for _ in range(RULES.passes):
        means = [
            -(gram @ estimate.beta)[own]
            for gram, own in zip(grams, information.support, strict=True)
        ]
        expected = ExpectedScores(names, tuple(means))
        corrected = information.less(expected.torques(information))
        estimate = fit_least_squares(corrected, weights=estimate.weights, prior=prior)
    return PoseNoise(estimate.beta, expected, growth)


def _average_noise(model: RobotModel, base: BaseParameters, samples: Samples) -> Array:
    """Return the mean `E[dW_k^T dW_k]` (n, p, p) over the states of samples."""
    found = np.zeros((model.n_joints, base.n_base, base.n_base))
    if not samples.pose_noise or samples.contact is None:
        return found
    step = max(1, -(-len(samples.q) // RULES.states))
    q, contact = samples.q[::step], samples.contact[::step]
    still = np.zeros_like(q)
    scale = np.array(samples.noise) if samples.noise else np.ones(model.n_joints)
    basis = contact_basis(model, q, contact, samples.noise)

    def rows(qdd: Array) -> Array:
        return observation_matrix(model, q, still, qdd, drive=base.drive, columns=base.columns)

    rest = rows(still)
    for c, variance in enumerate(samples.pose_noise[: model.n_floating]):
        unit = still.copy()
        unit[:, c] = 1.0
        moved = (rows(unit) - rest).reshape(len(q), len(scale), -1) / scale[:, None]
        moved -= np.einsum("mns,mks,skp->snp", basis, basis, moved, optimize=True)
        found += variance / len(q) * np.einsum("snp,snr->npr", moved, moved, optimize=True)
    return found
