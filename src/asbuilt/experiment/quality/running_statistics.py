"""What is known of the samples seen so far and takes in more of them.

Extremes, the furthest, moments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, Indices

IN_STEP = 0.995
"""Correlation of positions from which joints move in step."""


@dataclass(frozen=True, eq=False)
class Extremes:
    """How many numbers a column held, the lowest and the highest of them, all (n,).

    Infinite where it held none.
    """

    count: Indices
    low: Array
    high: Array

    @classmethod
    def none(cls, n: int) -> Extremes:
        """Return what is known before the first sample."""
        return cls(np.zeros(n, dtype=np.int64), np.full(n, np.inf), np.full(n, -np.inf))

    def with_more(self, values: Array) -> Extremes:
        """Take in further values (N, n), of which those that are not finite do not count."""
        there = np.isfinite(values)
        return Extremes(
            self.count + there.sum(axis=0),
            np.minimum(self.low, np.where(there, values, np.inf).min(axis=0, initial=np.inf)),
            np.maximum(self.high, np.where(there, values, -np.inf).max(axis=0, initial=-np.inf)),
        )


@dataclass(frozen=True, eq=False)
class Furthest:
    """Of every joint: in how many samples something was too far, and amount, value and row of the
    furthest, all (n,).
    """

    count: Indices
    amount: Array
    value: Array
    row: Indices

    @classmethod
    def none(cls, n: int) -> Furthest:
        """Return what is known before the first sample."""
        return cls(
            np.zeros(n, dtype=np.int64),
            np.full(n, -np.inf),
            np.full(n, np.nan),
            np.zeros(n, dtype=np.int64),
        )

    def with_more(
        self, amount: Array, too_far: NDArray[np.bool_], value: Array, rows: Indices
    ) -> Furthest:
        """Take in further samples: amounts, which of them are too far, values (N, n) and rows (N,).

        Amounts may be NaN.
        """
        if not len(rows):
            return self
        amount = np.where(np.isnan(amount), -np.inf, amount)
        place, columns = np.argmax(amount, axis=0), np.arange(amount.shape[1])
        worst = amount[place, columns]
        further = worst > self.amount
        return Furthest(
            self.count + too_far.sum(axis=0),
            np.where(further, worst, self.amount),
            np.where(further, value[place, columns], self.value),
            np.where(further, rows[place], self.row),
        )


@dataclass(frozen=True, eq=False)
class Likeness:
    """Moments of the samples whose positions are all there.

    How many, their extremes (n,), sums (n,) and products (n, n) about the first of them.
    """

    n_samples: int
    low: Array
    high: Array
    about: Array
    total: Array
    products: Array

    @classmethod
    def none(cls, n: int) -> Likeness:
        """Return what is known before the first sample."""
        return cls(
            0, np.full(n, np.inf), np.full(n, -np.inf), np.zeros(n), np.zeros(n), np.zeros((n, n))
        )

    def with_more(self, q: Array) -> Likeness:
        """Take in further positions (N, n)."""
        whole = q[np.all(np.isfinite(q), axis=1)]
        if not len(whole):
            return self
        about = self.about if self.n_samples else whole[0]
        apart = whole - about
        return Likeness(
            self.n_samples + len(whole),
            np.minimum(self.low, whole.min(axis=0)),
            np.maximum(self.high, whole.max(axis=0)),
            about,
            self.total + apart.sum(axis=0),
            self.products + apart.T @ apart,
        )

    @property
    def moving(self) -> list[int]:
        """The joints that move at all."""
        return [int(k) for k in np.flatnonzero(self.high > self.low)]

    def correlations(self, joints: list[int]) -> Array:
        """Return the correlation coefficients of the positions of joints that move."""
        mean = self.total[joints] / self.n_samples
        covariance = self.products[np.ix_(joints, joints)] / self.n_samples - np.outer(mean, mean)
        size = np.sqrt(np.diag(covariance))
        return np.asarray(np.clip(covariance / np.outer(size, size), -1.0, 1.0))
