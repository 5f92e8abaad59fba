"""Directions of a robot type that a day of motion determines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.workflow.fleet.drift.columns import FleetColumns, summed
from asbuilt.workflow.fleet.drift.days import Day


@dataclass(frozen=True, slots=True)
class DirectionRules:
    """Say which directions are kept; own choices, on virtual fleets of two types.

    `weakest` is the least eigenvalue of the information with columns scaled alike, relative to the
    largest; `most` directions; `days_each` is the least number of days of the fleet for each.
    """

    weakest: float = 2e-3
    most: int = 28
    days_each: float = 4.0
    iterations: int = 4


RULES = DirectionRules()


@dataclass(frozen=True, eq=False)
class Directions:
    """Hold r directions in the columns of a robot type, scaled to a mean information of 1 a day.

    Parameters
    ----------
    columns
        The columns of the type.
    weights
        Factors of the rows of each joint (n,): 1 / noise.
    basis
        The directions, (size, r).
    beta
        Base parameters of the type, toward which undetermined directions are resolved (p,).
    """

    columns: FleetColumns
    weights: Array
    basis: Array
    beta: Array

    @property
    def count(self) -> int:
        """Number of directions r."""
        return self.basis.shape[1]

    def reference(self, days: Sequence[Day]) -> Array:
        """Return the base parameters of a robot by all its days."""
        return self.columns.fit(summed(days), self.weights, self.beta)

    def scores(self, days: Sequence[Day], beta: Array) -> tuple[Array, Array]:
        """Return information (d, r, r) and score (d, r) of each day about a robot's parameters."""
        grams = np.array(
            [
                self.columns.information(day.grams, beta, self.weights, self.basis)
                for day in days
            ]
        )
        return grams[:, :-1, :-1], grams[:, :-1, -1]


def find_directions(columns: FleetColumns, robots: Sequence[Sequence[Day]]) -> Directions:
    """Return the directions in which the days of some robots of a type have information.

    They are the principal axes of the mean information of a day with columns scaled to equal
    length. The noise of a joint is the median over the robots of its RMS residual.
    """
    totals = [summed(days) for days in robots]
    samples = np.array([sum(day.n_samples for day in days) for days in robots], dtype=float)
    zero = np.zeros(columns.base.n_base)
    weights = 1.0 / np.maximum(_rms(columns, totals, samples, [zero] * len(totals)), 1e-300)
    floor = 1e-9 / float(weights.min())
    beta, own = zero, [zero] * len(totals)
    for _ in range(RULES.iterations):
        own = [columns.fit(grams, weights, zero) for grams in totals]
        weights = 1.0 / np.maximum(_rms(columns, totals, samples, own), floor)
    beta = np.median(own, axis=0)
    n_days = sum(len(days) for days in robots)
    J = np.zeros((columns.size, columns.size))
    for grams, values in zip(totals, own, strict=True):
        J += columns.information(grams, values, weights)[:-1, :-1] / n_days
    length = np.sqrt(np.diag(J))
    present = length > 1e-6 * length.max()
    scale = np.where(present, length, 1.0)
    S = np.where(np.outer(present, present), J / np.outer(scale, scale), 0.0)
    eigenvalues, axes = np.linalg.eigh(S)
    most = min(RULES.most, max(3, int(n_days / RULES.days_each)))
    kept = np.flatnonzero(eigenvalues > RULES.weakest * eigenvalues[-1])[-most:]
    basis = axes[:, kept] / np.sqrt(eigenvalues[kept]) / scale[:, None]
    return Directions(columns, weights, basis, beta)


def _rms(
    columns: FleetColumns,
    totals: Sequence[Sequence[Array]],
    samples: Array,
    betas: Sequence[Array],
) -> Array:
    energies = [columns.residual_energy(grams, b) for grams, b in zip(totals, betas, strict=True)]
    return np.asarray(np.median(np.sqrt(np.array(energies) / samples[:, None]), axis=0))
