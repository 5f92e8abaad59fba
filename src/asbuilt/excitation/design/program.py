"""Optimisation problem of a design: nodes, limits, criterion, prior information."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.excitation.design.interior_point import Evaluation, MotionProgram
from asbuilt.excitation.information.criteria import Criterion
from asbuilt.excitation.information.information import Information
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.parametrisation import Parametrisation
from asbuilt.excitation.state_constraint import StateConstraint


@dataclass(frozen=True, eq=False)
class Objective:
    """Evaluate `criterion(S (n_samples mean + prior) S)`, S the diagonal of `scale`.

    `scale` (p,) are units for the parameters, `n_samples` the independent samples of the motion,
    `prior` (p, p) information from earlier recordings.
    """

    information: Information
    criterion: Criterion
    scale: Array
    n_samples: float
    prior: Array | None = None

    def scaled(self, mean: Array) -> Array:
        """Return the whole information in units of `scale`."""
        total = self.n_samples * mean
        if self.prior is not None:
            total = total + self.prior
        return total * np.outer(self.scale, self.scale)

    def value(self, mean: Array) -> float:
        """Return the criterion of the mean information per sample (p, p)."""
        return self.criterion.value(self.scaled(mean))

    def value_and_gradient(self, mean: Array) -> tuple[float, Array]:
        """Return the criterion and its derivative with respect to the mean information."""
        value, gradient = self.criterion.value_and_gradient(self.scaled(mean))
        return value, self.n_samples * gradient * np.outer(self.scale, self.scale)


class DesignProgram(MotionProgram):
    """Maximise an objective over the coefficients of a family of motions.

    Nodes are the midpoints of equal intervals.
    """

    def __init__(
        self,
        objective: Objective,
        family: Parametrisation,
        bounds: MotionBounds,
        n_nodes: int,
        constraints: tuple[StateConstraint, ...] = (),
        tightening: float = 0.0,
        margin: float = 0.0,
    ) -> None:
        self.objective = objective
        self.family = family
        self.constraints = constraints
        self.margin = margin
        t = (np.arange(n_nodes) + 0.5) * family.span / n_nodes
        orders = range(4 if np.any(np.isfinite(bounds.jerk)) else 3)
        self.bases = tuple(family.basis(t, order) for order in orders)
        symmetric = np.stack([bounds.velocity, bounds.acceleration, bounds.jerk])[
            : len(self.bases) - 1
        ]
        self.half = (1 - tightening) * np.vstack([(bounds.upper - bounds.lower) / 2, symmetric])
        self.centre = np.vstack([(bounds.upper + bounds.lower) / 2, np.zeros_like(symmetric)])

    def evaluate(self, q: Array, qd: Array, qdd: Array) -> Evaluation:
        """Return the objective of the motion."""
        information = self.objective.information
        rows = information.rows(q, qd, qdd)
        value, sensitivity = self.objective.value_and_gradient(
            information.matrix(rows, len(q)) / len(q)
        )
        return Evaluation(
            value, lambda: information.state_gradient(q, qd, qdd, rows, sensitivity / len(q))
        )
