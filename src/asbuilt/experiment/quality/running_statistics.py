"""Running statistics of the columns of a recording: extremes, largest exceedance, moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Indices, Mask

IN_STEP = 0.995
"""Correlation of positions from which joints move in step."""


@dataclass(frozen=True, eq=False)
class Extremes:
    """Hold count, lowest and highest finite value of each column, all (n,); infinite if none."""

    count: Indices
    low: Array
    high: Array

    @classmethod
    def none(cls, n: int) -> Extremes:
        """Return the statistics of no sample."""
        return cls(np.zeros(n, dtype=np.int64), np.full(n, np.inf), np.full(n, -np.inf))

    def with_more(self, values: Array) -> Extremes:
        """Include further values (N, n); those that are not finite do not count."""
        finite = np.isfinite(values)
        return Extremes(
            self.count + finite.sum(axis=0),
            np.minimum(self.low, values.min(axis=0, where=finite, initial=np.inf)),
            np.maximum(self.high, values.max(axis=0, where=finite, initial=-np.inf)),
        )


@dataclass(frozen=True, eq=False)
class Exceedance:
    """Hold for each column how many samples exceed a bound, and amount, value and row of the worst.

    All are (n,).
    """

    count: Indices
    amount: Array
    value: Array
    row: Indices

    @classmethod
    def none(cls, n: int) -> Exceedance:
        """Return the statistics of no sample."""
        zeros = np.zeros(n, dtype=np.int64)
        return cls(zeros, np.full(n, -np.inf), np.full(n, np.nan), zeros)

    def with_more(self, amount: Array, exceeds: Mask, value: Array, rows: Indices) -> Exceedance:
        """Include amounts (may be NaN), which exceed, values, all (N, n), and rows (N,)."""
        if not len(rows):
            return self
        amount = np.where(np.isnan(amount), -np.inf, amount)
        place, columns = np.argmax(amount, axis=0), np.arange(amount.shape[1])
        worst = amount[place, columns]
        worse = worst > self.amount
        return Exceedance(
            self.count + exceeds.sum(axis=0),
            np.where(worse, worst, self.amount),
            np.where(worse, value[place, columns], self.value),
            np.where(worse, rows[place], self.row),
        )


@dataclass(frozen=True, eq=False)
class PositionMoments:
    """Hold first and second moments of complete samples of positions, about the first of them.

    `about` and `total` are (n,), `products` (n, n).
    """

    n_samples: int
    about: Array
    total: Array
    products: Array

    @classmethod
    def none(cls, n: int) -> PositionMoments:
        """Return the moments of no sample."""
        return cls(0, np.zeros(n), np.zeros(n), np.zeros((n, n)))

    def with_more(self, q: Array) -> PositionMoments:
        """Include further positions (N, n); rows with a value that is not finite do not count."""
        complete = q[np.all(np.isfinite(q), axis=1)]
        if not len(complete):
            return self
        about = self.about if self.n_samples else complete[0]
        apart = complete - about
        return PositionMoments(
            self.n_samples + len(complete),
            about,
            self.total + apart.sum(axis=0),
            self.products + apart.T @ apart,
        )

    @property
    def moving(self) -> list[int]:
        """Joints whose position varies."""
        return [int(k) for k in np.flatnonzero(np.diag(self.products) > 0.0)]

    def correlations(self, joints: list[int]) -> Array:
        """Return the correlation coefficients of the positions of joints that move."""
        mean = self.total[joints] / self.n_samples
        covariance = self.products[np.ix_(joints, joints)] / self.n_samples - np.outer(mean, mean)
        size = np.sqrt(np.diag(covariance))
        return np.asarray(np.clip(covariance / np.outer(size, size), -1.0, 1.0))
