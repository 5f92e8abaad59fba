"""Bias by noise of the pose of a free base, and the scores that take it away.

Accelerations by differences have the noise d of the pose, W = W_0 + dW with
`dW_k = sum_c P dW_k/dqdd_c d_c`. Residuals at the true parameters are noise of the torque
less `dW beta`, so that the scores have the mean `E[W_k^T e_k] = -E[dW_k^T dW_k] beta`: least
squares explain noise by bodies that are too light (Fuller, Measurement Error Models, 1987, section
2.2).
Nothing drives a base, so that its equations lose most. Where they weigh as their noise says the
bias is many standard errors, and without it they have the most information.

Equations of a base have the noise of its pose, differentiated twice and multiplied by the mass of
the whole robot: a force [N], a moment [N m]. Equations of the joints have the noise of their
torques, which is of another size. So there are three sizes of noise. The residual of
`P (tau - Y chi)` has parts of all equations, `P e`, and for noise that is independent from equation
to equation the mean square of row k is `sum_j <P_kj^2> sigma_j^2`. The residual is taken with a fit
without the bias by noise of the pose (`expect_pose_noise`), which depends on the weights in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import BaseParameters, find_base_parameters, observation_matrix
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import AsbuiltError
from asbuilt.experiment import Recording, Samples, resolve_chain
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.experiment.signal.signal_chain import SignalChain, Velocity
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import (
    SquareRootInformation,
    accumulate_stream,
)
from asbuilt.identification.information.triangular import triangular_factor

DOUBT = 0.2
"""Standard error of what is taken away, as a share of it: noise is not quite white, friction not
quite Coulomb's, and the replayed robot has errors itself. Settled on a virtual quadruped."""


@dataclass(frozen=True, slots=True, eq=False)
class MeanScores:
    """Hold the mean over samples of `[W_k, ...]^T e_k` for every joint k and a torque e_k.

    Where e_k is the torque at the true parameters less `W_k beta`, it is what does not average out.
    `names[k]` name the parameters of W_k; `means[k]` has their entries first, then entries of
    further columns.
    """

    names: tuple[tuple[str, ...], ...]
    means: tuple[Array, ...]

    def of_parameters(self, k: int, names: Sequence[str]) -> Array:
        """Return the part of joint k that belongs to these parameters, 0 for others."""
        by_name = dict(zip(self.names[k], self.means[k].tolist(), strict=False))
        return np.array([by_name.get(name, 0.0) for name in names])

    def torques(self, information: SquareRootInformation) -> tuple[Array, ...]:
        """Return parameters x_k (p_k,) of each joint with `W_k^T W_k x_k` = the sum of its scores.

        Least squares of `tau_k - W_k x_k` has scores of mean zero.
        """
        solutions = []
        for k, (support, factor) in enumerate(
            zip(information.support, information.joint_factors, strict=True)
        ):
            score = information.n_samples * self.of_parameters(
                k, [information.base.names[j] for j in support]
            )
            # Unit columns, so that the rank does not depend on units.
            scale = np.linalg.norm(factor[:, :-1], axis=0)
            scale[scale == 0.0] = 1.0
            _, values, axes = np.linalg.svd(factor[:, :-1] / scale, full_matrices=False)
            # Singular value of scaled columns, relative to the largest, below which a direction is
            # empty.
            there = values > 1e-7 * values[0]
            # A direction without information has no score either, and keeps the parameter 0.
            turned = axes[there] @ (score / scale) / values[there] ** 2
            solutions.append(axes[there].T @ turned / scale)
        return tuple(solutions)

    def follow(self, information: SquareRootInformation, estimate: Estimate) -> Array:
        """Return what an estimate (p,) gains by torques e_k: `(W^T W)^-1 sum_k w_k^2 W_k^T e_k`.

        Parameters that the estimate has not regrouped alike do not follow.
        """
        side = np.zeros(information.base.n_base)
        for k, (support, weight) in enumerate(
            zip(information.support, estimate.weights, strict=True)
        ):
            # Summed per sample: rows of the scores and of the estimate may differ in number.
            score = self.of_parameters(k, [information.base.names[j] for j in support])
            side[support] += weight**2 * information.n_samples * score
        root = estimate.solution.inverse_root
        return root @ (root.T @ side)

    def doubt(self, information: SquareRootInformation, estimate: Estimate) -> Array:
        """Return the covariance (p, p) of an estimate by the error of what was taken away."""
        moved = DOUBT * self.follow(information, estimate)
        return np.outer(moved, moved)


# Say how the squares of noise are averaged, and how often scores are found: own choices.

POSE_NOISE_STATES = 400  # States of a recording over which the squares of its noise are averaged
POSE_NOISE_PASSES = 5  # Passes: each leaves the share of the bias that noise has of a direction
# Share of noise in what was observed of a direction, up to which chance explains that it exceeds 1;
# beyond, rows are next to zero there, and least squares say nothing of bodies
POSE_NOISE_POSSIBLE = 2.0


class PoseNoise(NamedTuple):
    """Base parameters (p,) of least squares, and what noise of the pose lends them.

    `scores` is None where the noise is unknown, or rows of a direction are next to zero. `growth`
    (p,) multiplies standard errors: what takes back a bias takes random errors along.
    """

    beta: Array
    scores: MeanScores | None
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
    if not any(any(batch.pose_noise) for batch in samples):
        return uncorrected
    total = sum(len(batch.q) for batch in samples)
    shares = [len(batch.q) / total * _average_noise(model, base, batch) for batch in samples]
    grams = np.sum(shares, axis=0)
    names = tuple(tuple(base.names[j] for j in support) for support in information.support)
    squares = np.einsum("n,npr->pr", estimate.weights**2, grams) * information.n_samples
    root = estimate.solution.inverse_root
    # In whitened parameters the noise's part of the information of each direction.
    share, axes = np.linalg.eigh(root.T @ squares @ root)
    if np.abs(share).max() > POSE_NOISE_POSSIBLE:
        return uncorrected
    # No direction holds more noise than all that was observed of it.
    share = np.maximum(share, 0.0)
    kept = 1.0 / np.maximum(share, 1.0)
    along = root @ axes
    of = axes.T @ np.linalg.pinv(root)
    # Directions with more noise than observed signal get as much as was observed.
    grams = grams @ (np.eye(base.n_base) + (along * (kept - 1.0)) @ of)
    # Each pass adds a power of the share: the series of (1 - share)^-1, cut off.
    taken = sum(
        ((kept * share) ** k for k in range(1, POSE_NOISE_PASSES + 1)), np.zeros(len(share))
    )
    before, grown = (
        np.linalg.norm(directions, axis=1) for directions in (along, along * (1.0 + taken))
    )
    growth = np.divide(grown, before, out=np.ones(base.n_base), where=before > 0.0)
    expected: MeanScores | None = None
    for _ in range(POSE_NOISE_PASSES):
        pairs = zip(grams, information.support, strict=True)
        expected = MeanScores(
            names, tuple(-(gram @ estimate.beta)[support] for gram, support in pairs)
        )
        estimate = fit_least_squares(
            information.less(expected.torques(information)), weights=estimate.weights, prior=prior
        )
    return PoseNoise(estimate.beta, expected, growth)


def _average_noise(model: RobotModel, base: BaseParameters, samples: Samples) -> Array:
    """Return the mean `E[dW_k^T dW_k]` (n, p, p) over the states of samples."""
    squares = np.zeros((model.n_joints, base.n_base, base.n_base))
    if not (samples.pose_noise and samples.reactions):
        return squares
    step = max(1, -(-len(samples.q) // POSE_NOISE_STATES))
    q = samples.q[::step]
    reactions = samples.reactions.at(slice(None, None, step))
    still = np.zeros_like(q)
    scale = np.array(reactions.noise) if reactions.noise else np.ones(model.n_joints)
    basis = reactions.basis(model, q)

    def rows(qdd: Array) -> Array:
        return observation_matrix(model, q, still, qdd, drive=base.drive, columns=base.columns)

    rest = rows(still)
    of_base = samples.pose_noise[: model.driven_joints.start]
    for unit, variance in zip(np.eye(model.n_joints), of_base, strict=False):
        # W is linear in the accelerations, so that a unit gives dW, in units of the equation's
        # noise.
        moved = (rows(still + unit) - rest).reshape(len(q), len(scale), -1) / scale[:, None]
        # P dW: what reactions take is taken from the noise as well.
        moved -= np.einsum("mns,mks,skp->snp", basis, basis, moved, optimize=True)
        squares += variance / len(q) * np.einsum("snp,snr->npr", moved, moved, optimize=True)
    return squares


# Say how the noise of equations is found: own choices.

EQUATION_UPDATES = 100  # Multiplicative updates, of which each brings the variances closer
# Fits, each with the noise by the residual of the one before: the last changes 1 %
EQUATION_FITS = 3
EQUATION_LARGEST_RATIO = 1e3  # Largest noise of an equation in units of the least
EQUATION_SAMPLES = 2000  # Samples of each recording whose projections are averaged


def with_equation_noise(model: RobotModel, samples: Sequence[Samples]) -> tuple[Samples, ...]:
    """Return samples whose equations are weighted by their noise where feet touch the ground.

    The noise is relative to the noise of the driven joints. Samples without reactions are returned
    as they are.
    """
    if not (model.has_reactions and all(batch.reactions for batch in samples)):
        return tuple(samples)
    base = find_base_parameters(model, choose_usual_drive(model, samples[0].torque_source))
    seen = accumulate_stream(model, base, samples)
    shares = np.mean([_average_squared_projection(model, batch) for batch in samples], axis=0)
    # Forces and moments on the base, and torques of the driven joints.
    group = np.array([int(joint.is_revolute) for joint in model.joints])
    group[model.driven_joints] = 2
    plain = weighted = tuple(samples)
    for _ in range(EQUATION_FITS):
        information = seen if weighted is plain else accumulate_stream(model, base, weighted)
        beta = expect_pose_noise(model, base, weighted, information).beta
        squares = seen.residual_energy(beta) / seen.n_samples
        variances = solve_equation_variances(shares @ np.eye(3)[group], squares)
        # Relative to the driven joints, whose weights the fit finds itself.
        noise = tuple(np.sqrt(variances / variances[2])[group].tolist())
        weighted = tuple(
            replace(batch, reactions=batch.reactions.in_units_of(noise)) for batch in samples
        )
    return weighted


def solve_equation_variances(shares: Array, squares: Array) -> Array:
    """Return variances x (m,) of independent noise for which `shares x` is `squares`.

    `shares` (n, m) are mean squares of the projection and `squares` (n,) mean squares of residuals.
    The updates raise the likelihood of normal residuals (Fevotte, Bertin and Durrieu, Neural
    Computation 21, 2009, with exponent 1/2), from equal variances on.

    >>> solve_equation_variances(np.array([[1.0, 0.0], [0.5, 0.5]]), np.array([4.0, 2.5])).round(2)
    array([4., 1.])
    """
    # A row with no residual would take the whole weight.
    squares = np.maximum(squares, squares.max() / EQUATION_LARGEST_RATIO**2)
    x = np.full(shares.shape[1], float(squares.mean()))
    for _ in range(EQUATION_UPDATES):
        expected = shares @ x
        x = x * np.sqrt((shares.T @ (squares / expected**2)) / (shares.T @ (1.0 / expected)))
    return np.asarray(np.maximum(x, x.max() / EQUATION_LARGEST_RATIO**2))


def _average_squared_projection(model: RobotModel, samples: Samples) -> Array:
    """Return the mean of `P_kj^2` (n, n) over samples."""
    at = np.linspace(0, samples.t.size - 1, min(EQUATION_SAMPLES, samples.t.size)).astype(np.int64)
    basis = samples.reactions.in_units_of(()).at(at).basis(model, samples.q[at])
    # P = 1 - Q^T Q with an orthonormal basis Q of what reactions act on.
    P = np.eye(model.n_joints) - np.einsum("ikn,ijn->nkj", basis, basis)
    return np.asarray(np.mean(P**2, axis=0))


def settle_rates(
    model: RobotModel, heads: Sequence[Recording], chain: SignalChain, filters: MotionFilters
) -> SignalChain:
    """Return the chain with the rates from which the torque of a free base follows better.

    Feet that touch down turn joints faster than positions at the rate of a log resolve, so that
    high frequencies are no measure of noise, as they are for an arm (`compare_velocities`). What
    rates are for decides: the torque. Rows, torques and parameters of both fits are the same, so
    that the smaller residual of least squares decides. The chain stays open where a log holds no
    velocities.
    """
    if chain.velocity != "auto" or any(head.qd is None for head in heads):
        return chain
    # Both fits have the same low-pass, so that the rates alone differ.
    alike = resolve_chain(chain, *heads, filters=filters)
    base = find_base_parameters(model, choose_usual_drive(model, heads[0].torque_source))

    def residual(velocity: Velocity) -> float:
        chain_of_rates = replace(alike, velocity=velocity, delay=None)
        samples = [filters.prepare(head, chain_of_rates).samples() for head in heads]
        # The last entry of a triangle of rows and torque is the residual.
        factor = triangular_factor(accumulate_stream(model, base, samples).stacked())
        return float(factor[-1, -1])

    try:
        measured = residual("measured") < residual("derived")
    except (AsbuiltError, np.linalg.LinAlgError):
        return chain
    return replace(chain, velocity="measured" if measured else "derived")
