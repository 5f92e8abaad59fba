"""Noise of each equation of motion where forces at contacts are projected away.

Equations of a base have the noise of its pose, differentiated twice and multiplied by the mass of
the whole robot: a force [N], a moment [N m]. Those of the joints have the noise of their torques,
which is of another size. So there are three sizes of noise. The residual of `P (tau - Y chi)` has
parts of all equations, `P e`, and for noise that is independent from equation to equation the mean
square of row k is `sum_j <P_kj^2> sigma_j^2`.

The residual is taken with a fit without the bias by noise of the pose (`expect_pose_noise`), which
depends on the weights in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.contact import contact_basis
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.errors.pose_noise import expect_pose_noise
from asbuilt.identification.information.square_root_information import accumulate_stream


@dataclass(frozen=True, slots=True)
class EquationRules:
    """Say how the noise of equations is found: own choices."""

    updates: int = 100
    """Multiplicative updates, of which each brings the variances closer."""
    fits: int = 3
    """Fits, each with the noise by the residual of the one before: the last changes 1 %."""
    largest_ratio: float = 1e3
    """Largest noise of an equation in units of the least."""
    samples: int = 2000
    """Samples of each recording whose projections are averaged."""


RULES = EquationRules()


def with_equation_noise(model: RobotModel, samples: Sequence[Samples]) -> tuple[Samples, ...]:
    """Return samples whose equations are weighted by their noise where feet touch the ground.

    The noise is relative to the noise of the driven joints. Samples of robots without contacts are
    returned as they are.
    """
    if not model.contacts or any(each.contact is None for each in samples):
        return tuple(samples)
    base = find_base_parameters(model, choose_usual_drive(model, samples[0].torque_source))
    seen = accumulate_stream(model, base, samples)
    shares = np.mean([_average_squared_projection(model, each) for each in samples], axis=0)
    group = np.array(
        [
            2 if k >= model.n_floating else int(model.joints[k].is_revolute)
            for k in range(len(shares))
        ]
    )
    plain = weighted = tuple(samples)
    for _ in range(RULES.fits):
        information = seen if weighted is plain else accumulate_stream(model, base, weighted)
        beta = expect_pose_noise(model, base, weighted, information).beta
        squares = seen.residual_energy(beta) / seen.n_samples
        variances = solve_equation_variances(shares @ np.eye(3)[group], squares)
        noise = tuple(np.sqrt(variances / variances[2])[group].tolist())
        weighted = tuple(replace(each, noise=noise) for each in samples)
    return weighted


def solve_equation_variances(shares: Array, squares: Array) -> Array:
    """Return variances x (m,) of independent noise for which `shares x` is `squares`.

    `shares` (n, m) are mean squares of the projection and `squares` (n,) mean squares of residuals.
    The updates raise the likelihood of normal residuals (Fevotte, Bertin and Durrieu, Neural
    Computation 21, 2009, with exponent 1/2), from equal variances on.

    >>> solve_equation_variances(np.array([[1.0, 0.0], [0.5, 0.5]]), np.array([4.0, 2.5])).round(2)
    array([4., 1.])
    """
    squares = np.maximum(squares, squares.max() / RULES.largest_ratio**2)
    x = np.full(shares.shape[1], float(squares.mean()))
    for _ in range(RULES.updates):
        expected = shares @ x
        x = x * np.sqrt((shares.T @ (squares / expected**2)) / (shares.T @ (1.0 / expected)))
    return np.asarray(np.maximum(x, x.max() / RULES.largest_ratio**2))


def _average_squared_projection(model: RobotModel, samples: Samples) -> Array:
    """Return the mean of `P_kj^2` (n, n) over samples."""
    assert samples.contact is not None
    at = np.linspace(0, samples.t.size - 1, min(RULES.samples, samples.t.size)).astype(np.int64)
    basis = contact_basis(model, samples.q[at], samples.contact[at])
    P = np.eye(model.n_joints) - np.einsum("ikn,ijn->nkj", basis, basis)
    return np.asarray(np.mean(P**2, axis=0))
