"""Scores `W^T e` whose mean is not zero, and the torque that takes them away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.information.estimate import Estimate
from asbuilt.identification.information.square_root_information import SquareRootInformation

DOUBT = 0.2
"""Standard error of what is taken away, as a share of it: noise is not quite white, friction not
quite Coulomb's, and the replayed robot has errors itself. Settled on a virtual quadruped."""


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedScores:
    """Hold the mean over samples of `[W_k, ...]^T e_k` at the true parameters, for every joint k.

    `e_k` is the torque of the joint less `W_k beta`. `names[k]` are those of the parameters of
    W_k; `means[k]` has their entries first, then those of further columns.
    """

    names: tuple[tuple[str, ...], ...]
    means: tuple[Array, ...]

    def of_parameters(self, k: int, names: Sequence[str]) -> Array:
        """Return the part of joint k that belongs to these parameters, 0 for others."""
        found = dict(zip(self.names[k], self.means[k].tolist(), strict=False))
        return np.array([found.get(name, 0.0) for name in names])

    def torques(self, information: SquareRootInformation) -> tuple[Array, ...]:
        """Return parameters x_k (p_k,) of each joint with `W_k^T W_k x_k` = the sum of its scores.

        Least squares of `tau_k - W_k x_k` has scores of mean zero.
        """
        found = []
        for k, (support, factor) in enumerate(
            zip(information.support, information.joint_factors, strict=True)
        ):
            names = [information.base.names[j] for j in support]
            score = information.n_samples * self.of_parameters(k, names)
            R = factor[:-1, :-1]
            scale = np.linalg.norm(R, axis=0)
            scale = np.where(scale > 0.0, scale, 1.0)
            _, values, axes = np.linalg.svd(R / scale)
            # Singular value of scaled columns, relative to the largest, below which a direction is
            # empty.
            there = values > 1e-7 * values[0]
            turned = axes[there] @ (score / scale) / values[there] ** 2
            found.append(axes[there].T @ turned / scale)
        return tuple(found)

    def doubt(self, information: SquareRootInformation, estimate: Estimate) -> Array:
        """Return the covariance (p, p) of an estimate by the error of what was taken away."""
        side = np.zeros(information.base.n_base)
        for k, (support, weight) in enumerate(
            zip(information.support, estimate.weights, strict=True)
        ):
            names = [information.base.names[j] for j in support]
            side[support] += weight**2 * information.n_samples * self.of_parameters(k, names)
        root = estimate.solution.inverse_root
        moved = DOUBT * root @ (root.T @ side)
        return np.outer(moved, moved)
