"""Scan over the days of a robot for one change, with a p-value that allows for the scan."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import chdtrc, fdtrc

from asbuilt.arrays import Array
from asbuilt.scaled import Scaled

DRAWS = 4000
"""Simulated histories without a change."""
FEWEST_HISTORIES = 12
"""Shuffled histories below which the theoretical distribution is used."""
MOST_DEGREES = 2.0
"""Most degrees of freedom fitted, in the number of directions."""
RESOLVED = 40
"""Rank among them below which the simulation is not used."""


@dataclass(frozen=True, slots=True)
class ScanRules:
    """Say where a change may lie: at least so many days before it and after it."""

    before: int = 3
    after: int = 2


SCAN = ScanRules()


@dataclass(frozen=True, slots=True)
class NullDistribution:
    """Describe the statistic of a change at a given candidate without one.

    It is `scale first` times an F variable with `first` and `second` degrees of freedom; infinite
    `second`: `scale` times a chi-square variable. p-values of scans are raised to `power`, at most
    1, so that 5 % of histories without a change have one below 5 %.
    """

    scale: float
    first: float
    second: float = np.inf
    power: float = 1.0

    @classmethod
    def theoretical(cls, r: int) -> NullDistribution:
        """Return the distribution for a known variation: chi-square with r degrees of freedom."""
        return cls(1.0, float(r))

    @classmethod
    def fitted(cls, values: Array, r: int, degrees: float, histories: int) -> NullDistribution:
        """Return that with the mean and variance of statistics without a change.

        The F variable has the second degrees of freedom of Hotelling's statistic for a covariance
        with `degrees` degrees of freedom, nu - r + 1 (Anderson, An Introduction to Multivariate
        Statistical Analysis, 2003, section 5.2).
        """
        second = degrees - r + 1.0 if degrees - r + 1.0 >= 10.0 else np.inf
        tail = (second - 2.0) / second if np.isfinite(second) else 1.0
        if histories < FEWEST_HISTORIES:
            return cls(1.0 / tail, float(r), second)
        mean = float(values.mean())
        variation = float(values.var() / values.mean() ** 2)
        if np.isfinite(second):
            spare = (second - 4.0) * variation - 2.0
            first = 2.0 * (second - 2.0) / spare if spare > 0.0 else MOST_DEGREES * r
        else:
            first = 2.0 / variation
        first = float(np.clip(first, 1.0, MOST_DEGREES * r))
        return cls(mean * tail / first, first, second)

    def exceeded(self, statistic: float | Array) -> Array:
        """Return the probability of a larger statistic."""
        if not np.isfinite(self.second):
            return np.asarray(chdtrc(self.first, np.asarray(statistic) / self.scale))
        scaled = np.asarray(statistic) / (self.scale * self.first)
        return np.asarray(fdtrc(self.first, self.second, scaled))


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Hold the result of a scan.

    Parameters
    ----------
    statistics
        Wald statistic of a change at each candidate.
    candidates
        First day after the change, of each.
    place
        The candidate of the largest statistic.
    statistic
        The largest.
    p_value
        Probability of as large a one without a change.
    """

    statistics: Array
    candidates: Array
    place: int
    statistic: float
    p_value: float


def scan(
    information: Array,
    score: Array,
    variation: Array,
    *,
    null: NullDistribution | None = None,
    inflation: float = 1.0,
    first: int = 0,
) -> Scan | None:
    """Look for one change of the mean in d days of r directions.

    Day t gives `y_t = mu + delta [t >= c] + v_t + e_t` with `cov v = V`, `cov e = J_t^-1`; its
    weight is `P_t = (V + J_t^-1)^-1 = (I + J_t V)^-1 J_t`, which exists for singular J_t. The
    statistic of a change at c is Wald's for delta = 0, chi-square with r degrees of freedom
    without a change if V is known.

    Parameters
    ----------
    information, score
        J_t (d, r, r) and `J_t y_t` (d, r).
    variation
        V (r, r), positive semidefinite.
    null
        Distribution of the statistic without a change; None: chi-square.
    inflation
        Factor of the variance that autocorrelation and the robot's own spread add.
    first
        First day that may be the first after the change.

    Returns
    -------
    Scan or None
        None if there are too few days.
    """
    d, r = score.shape
    candidates = np.arange(max(SCAN.before, first), d - SCAN.after + 1)
    if not candidates.size:
        return None
    A = np.eye(r) + information @ variation
    P = np.linalg.solve(A, information)
    b = np.linalg.solve(A, score[..., None])[..., 0]
    N1 = np.cumsum(P, axis=0)[candidates - 1]
    b1 = np.cumsum(b, axis=0)[candidates - 1]
    N = P.sum(axis=0)
    total = b.sum(axis=0)
    inverse = Scaled(N).pseudo_inverse
    u = b1 - N1 @ (inverse @ total)
    C = N1 - N1 @ inverse @ N1
    C = (C + np.swapaxes(C, 1, 2)) / 2.0 + 1e-9 * np.trace(N) / r * np.eye(r)
    statistics = np.einsum("cr,cr->c", u, np.linalg.solve(C, u[..., None])[..., 0]) / inflation
    best = int(np.argmax(statistics))
    known = null or NullDistribution.theoretical(r)
    single = float(known.exceeded(statistics[best]))
    return Scan(
        statistics,
        candidates,
        int(candidates[best]),
        float(statistics[best]),
        scan_probability(single, d, r, int(candidates[0])) ** known.power,
    )


def scan_probability(single: float, d: int, r: int, first: int = SCAN.before) -> float:
    """Return the probability of so small a least p-value over all candidates of d days.

    Simulated without a change where simulations resolve it; below, the sum over the candidates
    (Bonferroni), which bounds it.
    """
    least = _draw_least_probabilities(d, r, first)
    bound = (d - SCAN.after + 1 - first) * single
    rank = int(np.searchsorted(least, single, side="right"))
    if rank >= RESOLVED:
        return float(min((rank + 1.0) / (DRAWS + 1.0), bound, 1.0))
    return float(min(bound, (RESOLVED + 1.0) / (DRAWS + 1.0)))


@lru_cache(maxsize=256)
def _draw_least_probabilities(d: int, r: int, first: int) -> Array:
    """Return the least p-values of histories without a change, sorted, (DRAWS,)."""
    rng = np.random.default_rng(0)
    candidates = np.arange(first, d - SCAN.after + 1)
    largest = []
    for _ in range(8):
        sums = np.cumsum(rng.standard_normal((DRAWS // 8, d, r)), axis=1)
        bridge = sums[:, candidates - 1] - candidates[:, None] / d * sums[:, -1:]
        size = np.sum(bridge**2, axis=2) / (candidates * (d - candidates) / d)
        largest.append(size.max(axis=1))
    found = np.sort(np.asarray(chdtrc(r, np.concatenate(largest))))
    found.setflags(write=False)
    return found
