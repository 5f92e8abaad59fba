"""Rows of identification for any direction of gravity, in which they are linear."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.dynamics.regressor import RegressorPlan
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.information.rows import JointFactors, sample_blocks
from asbuilt.identification.information.triangular import GrowingFactor


@dataclass(frozen=True, slots=True, eq=False)
class GravityRows:
    """Hold the factor of each joint's rows together with what gravity along x, y and z adds.

    `W(g) = W(g0) + sum_i (g - g0)_i G_i`, and G_i has a column for each first moment and mass:
    one pass over the samples gives the factor of the rows for every g.

    | attribute | meaning |
    |---|---|
    | `base` | the base parameters, p |
    | `gravity` | that of the rows, g0 (3,) [m/s^2] |
    | `columns` | positions among the base parameters of the m that gravity acts on |
    | `support` | positions (p_k,) of each joint's columns |
    | `factors` | factor of each joint's `[W_k | G_1 | G_2 | G_3 | tau_k]`, p_k + 3 m + 1 wide |
    """

    base: BaseParameters
    gravity: Array
    columns: Indices
    support: tuple[Indices, ...]
    factors: tuple[Array, ...]

    @classmethod
    def of(
        cls,
        model: RobotModel,
        base: BaseParameters,
        samples: Iterable[Samples],
        block_seconds: float | None = None,
    ) -> GravityRows:
        """Reduce samples, filtered as in `accumulate_stream`, in one pass."""
        of_links = np.flatnonzero(base.columns < 10 * base.n_links)
        # 6: place among the ten parameters of a link from which on gravity acts on them: first
        # moments and mass.
        columns = of_links[base.columns[of_links] % 10 >= 6]
        plan = RegressorPlan.of(model, base.drive, base.columns, spare_rows=3 * columns.size + 1)
        along = [
            RegressorPlan.of(model.with_gravity(axis), columns=base.columns[columns])
            for axis in np.eye(3)
        ]
        reduced = JointFactors(plan)

        def added(q: Array) -> list[Array]:
            found = []
            for own in along:
                rows = own.evaluate(q, np.zeros_like(q), np.zeros_like(q))
                values = np.zeros((columns.size, *q.shape))
                for k, (places, torques) in enumerate(zip(own.support, rows, strict=True)):
                    values[places, :, k] = torques
                found += list(values)
            return found

        for part in sample_blocks(model, samples, block_seconds):
            q = part.samples.q
            reduced.add(part, lambda span, q=q: added(q[span]))  # type: ignore[misc]
        gravity = np.array(model.gravity, dtype=np.float64)
        return cls(base, gravity, columns, plan.support, reduced.factors())

    def stacked(self, gravity: Array, weights: Sequence[float] | Array) -> Array:
        """Return the factor (p + 1, p + 1) of all joints' rows, joint k times `weights[k]`."""
        p, m = self.base.n_base, self.columns.size
        growing = GrowingFactor(p + 1, sum(map(len, self.factors)))
        for support, factor, weight in zip(self.support, self.factors, weights, strict=True):
            own = np.append(support, p)
            rows = np.zeros((len(factor), p + 1))
            rows[:, own] = factor[:, [*range(support.size), -1]]
            extra = factor[:, support.size : -1].reshape(len(factor), 3, m)
            rows[:, self.columns] += np.einsum("i,rim->rm", gravity - self.gravity, extra)
            growing.append(weight * rows[:, own].T, own)
        return growing.factor()

    def cost(self, gravity: Array, weights: Sequence[float] | Array, beta: Array) -> float:
        """Return `sum_k |weights[k] (tau_k - W_k(g) beta)|^2 / 2`."""
        turn, total = gravity - self.gravity, 0.0
        added = np.outer(turn, beta[self.columns]).ravel()
        for support, factor, weight in zip(self.support, self.factors, weights, strict=True):
            error = factor @ np.concatenate([-beta[support], -added, [1.0]])
            total += 0.5 * weight**2 * float(error @ error)
        return total
