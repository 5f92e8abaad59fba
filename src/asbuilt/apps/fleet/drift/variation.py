"""Natural variation from day to day, and the scan of a robot's days for a change beyond it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc

from asbuilt.arrays import Array
from asbuilt.scaled import Scaled

CLEAR = 1e-3
"""Probability of a scan below which a robot's history is cut for the estimate of variation."""
OUTLYING = 0.01
"""Probability of a squared distance from which on a day has less weight."""
OWN_DAYS = 12.0
"""Days of its siblings that count in addition to a robot's own spread."""
ITERATIONS = 3
STEPS = 4
"""Scoring steps between two scans."""
SHUFFLES = 8
FEWEST_SHUFFLED = 40
"""Shuffled histories from which the tail of the distribution is calibrated."""
LEVEL = 0.05
"""Probability at which it is."""
MOST_SHUFFLED = 60
"""Robots whose days are shuffled."""
WEAK = 1e-2
"""Information that is added to a day's in every direction, of a mean of 1."""
WIDE = 3
"""Days on both sides of a change that may belong to a gradual one, and do not count."""


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """Hold the days of a robot in r directions.

    Parameters
    ----------
    information, score
        (d, r, r) and (d, r), as in `scan`.
    covariates
        Temperatures (d, c); NaN where there is none.
    """

    information: Array
    score: Array
    covariates: Array

    @property
    def n_days(self) -> int:
        """Number of days d."""
        return len(self.score)

    @property
    def estimates(self) -> Array:
        """Estimate of each day, (d, r), weakly determined directions toward the reference."""
        weak = WEAK * np.eye(self.score.shape[1])
        return np.asarray(np.linalg.solve(self.information + weak, self.score[..., None])[..., 0])

    def without(self, coefficients: Array) -> History:
        """Return the history less what its temperatures explain, by coefficients (c, r)."""
        if not coefficients.size:
            return self
        # A robot may lack a temperature that others of its type have.
        known = [values[np.isfinite(values)] for values in self.covariates.T]
        usual = [np.median(values) if values.size else 0.0 for values in known]
        y = np.nan_to_num(self.covariates - usual, nan=0.0) @ coefficients
        return replace(self, score=self.score - np.einsum("drs,ds->dr", self.information, y))


@dataclass(frozen=True, slots=True, eq=False)
class Variation:
    """Hold the variation from day to day of the robots of a type.

    Parameters
    ----------
    covariance
        V (r, r) of a day about its robot's mean, without the noise of its log.
    inflations
        Factor of the variance of each robot: autocorrelation and its own spread.
    null
        Distribution of the statistic of a change without one.
    autocorrelation
        Of neighbouring days.
    coefficients
        Change by a unit of temperature, (c, r).
    """

    covariance: Array
    inflations: Array
    autocorrelation: float
    coefficients: Array
    null: NullDistribution


def estimate_variation(histories: Sequence[History]) -> Variation:
    """Estimate the variation of robots of a type by moments of weighted residuals.

    `y_t = mu + v_t + e_t` with a mean for each robot; V by scoring steps, which solve the moment
    equations of restricted maximum likelihood (Harville, J. Am. Stat. Assoc. 72, 1977), from
    differences of neighbouring days, which one change of a robot hardly moves. Robots whose scan
    then finds a change get a mean before and after it, and days far off less weight, so robots
    that changed do not count as varying (Huber, Robust Statistics, 1981, chapter 8).
    """
    coefficients = _fit_temperature(histories)
    histories = [history.without(coefficients) for history in histories]
    r = histories[0].score.shape[1]
    V = _estimate_first(histories)
    inflations = np.ones(len(histories))
    degrees = 0.0
    rho = 0.0
    for _ in range(ITERATIONS):
        robots = [
            _split_history(
                history, scan(history.information, history.score, V, inflation=inflation)
            )
            for history, inflation in zip(histories, inflations.tolist(), strict=True)
        ]
        counts = np.array([sum(len(score) - 1 for _, score in robot) for robot in robots])
        degrees = float(counts.sum())
        if not degrees:
            return Variation(V, inflations, 0.0, coefficients, NullDistribution.theoretical(r))
        for _ in range(STEPS):
            V = _step_scoring([segment for robot in robots for segment in robot], V)
        whitened = [[_whiten_residuals(J, s, V) for J, s in robot] for robot in robots]
        squares = np.array([sum(float(np.sum(z * z)) for z in robot) for robot in whitened])
        rho = _estimate_autocorrelation([z for robot in whitened for z in robot])
        inflations = np.maximum((r * OWN_DAYS + squares) / (r * (OWN_DAYS + counts)), 1.0)
    quiet = [
        (history, inflation)
        for history, inflation, robot in zip(histories, inflations.tolist(), robots, strict=True)
        if len(robot) == 1 and len(robot[0][1]) == history.n_days
    ]
    null = _simulate_null_distribution(quiet, V, degrees)
    return Variation(V, inflations * (1.0 + rho) / (1.0 - rho), rho, coefficients, null)


def _simulate_null_distribution(
    quiet: Sequence[tuple[History, float]], V: Array, degrees: float
) -> NullDistribution:
    """Return the distribution of the statistic in histories with their days in random order.

    Order means nothing without a change, so shuffled histories have none, and all else that the
    estimate of V does to the statistic (Good, Permutation, Parametric and Bootstrap Tests of
    Hypotheses, 2005).
    """
    rng = np.random.default_rng(0)
    shuffled = []
    for history, inflation in quiet[:: max(1, -(-len(quiet) // MOST_SHUFFLED))]:
        for _ in range(SHUFFLES):
            order = rng.permutation(history.n_days)
            found = scan(history.information[order], history.score[order], V, inflation=inflation)
            if found is not None:
                shuffled.append((found.statistics, history.n_days))
    pooled = np.concatenate([np.zeros(0), *(statistics for statistics, _ in shuffled)])
    null = NullDistribution.fitted(pooled, len(V), degrees, len(shuffled))
    if len(shuffled) < FEWEST_SHUFFLED:
        return null
    p = [
        scan_probability(float(null.exceeded(statistics.max())), d, len(V))
        for statistics, d in shuffled
    ]
    low = float(np.quantile(p, LEVEL))
    return replace(null, power=min(1.0, np.log(LEVEL) / np.log(max(low, 1e-12))))


def _estimate_first(histories: Sequence[History]) -> Array:
    """Return the covariance of differences of neighbouring days, far ones with less weight."""
    r = histories[0].score.shape[1]
    differences = [np.diff(history.estimates, axis=0) / np.sqrt(2.0) for history in histories]
    steps = np.concatenate(differences)
    if not len(steps):
        return np.zeros((r, r))
    S = np.diag(np.maximum(1.4826 * np.median(np.abs(steps), axis=0), 1e-12) ** 2)
    for _ in range(3):
        far = np.sum(Scaled(S).whiten(steps.T) ** 2, axis=0)
        weight = np.minimum(1.0, float(chdtri(r, OUTLYING)) / np.maximum(far, 1e-300))
        S = (steps * weight[:, None]).T @ steps / weight.sum()
        # Shrunk to its diagonal, the more the fewer steps there are.
        share = r / (r + len(steps))
        S = (1.0 - share) * S + share * np.diag(np.diag(S))
    return np.asarray(S)


def _split_history(history: History, change: Scan | None) -> list[tuple[Array, Array]]:
    """Return information and score of the days before and after a clear change."""
    J = history.information
    s = history.score
    if change is None or change.p_value >= CLEAR:
        return [(J, s)]
    spans = (slice(0, max(change.place - WIDE, 0)), slice(change.place + WIDE, None))
    return [(J[span], s[span]) for span in spans if len(s[span]) > 1]


def _weigh_about_mean(J: Array, s: Array, V: Array) -> tuple[Array, Array]:
    """Return the weights P_t of the days and `P_t (y_t - mu)`."""
    P, b = _weigh_days(J, s, V)
    mean = Scaled(P.sum(axis=0)).solve(b.sum(axis=0))
    return P, np.asarray(b - P @ mean)


def _weigh_days(J: Array, s: Array, V: Array) -> tuple[Array, Array]:
    """Return the weights `P_t = (V + J_t^-1)^-1 = (I + J_t V)^-1 J_t` of days, and `P_t y_t`."""
    A = np.eye(len(V)) + J @ V
    P = np.linalg.solve(A, J)
    b = np.linalg.solve(A, s[..., None])[..., 0]
    return np.asarray(P), np.asarray(b)


def _step_scoring(segments: Sequence[tuple[Array, Array]], V: Array) -> Array:
    """Return V after one step of scoring: `V + A^-1 (U - A) A^-1`.

    U is the mean of `u u^T` of the weighted residuals `u = P (y - mu)`, A its expectation. What is
    negative in units of the total covariance is zero.
    """
    r = len(V)
    weak = 1e-9 * np.eye(r)
    limit = float(chdtri(r, OUTLYING))
    U = np.zeros((r, r))
    A = weak
    n = 0
    for J, s in segments:
        P, u = _weigh_about_mean(J, s, V)
        # u^T P^+ u of each day: the squared distance from the mean.
        far = np.sum(u * np.linalg.solve(P + weak, u[..., None])[..., 0], axis=1)
        u = u * np.sqrt(np.minimum(1.0, limit / np.maximum(far, 1e-300)))[:, None]
        total = P.sum(axis=0)
        spent = np.einsum("tij,jk,tkl->il", P, Scaled(total).pseudo_inverse, P, optimize=True)
        U = U + u.T @ u
        A = A + total - spent
        n = n + len(s)
    values, axes = np.linalg.eigh((A + A.T) / 2.0)
    values = np.maximum(values, 1e-12 * values[-1])  # of logs that say nothing they are rounding
    root = axes / np.sqrt(values)
    change = n * (root @ (root.T @ U @ root - np.eye(r)) @ root.T)
    back = (axes * np.sqrt(values)) @ axes.T / np.sqrt(n)
    new = back @ (V + change) @ back
    values, axes = np.linalg.eigh((new + new.T) / 2.0)
    inverse = np.linalg.inv(back)
    return np.asarray(inverse @ ((axes * np.maximum(values, 0.0)) @ axes.T) @ inverse)


def _whiten_residuals(J: Array, s: Array, V: Array) -> Array:
    """Return residuals of unit covariance, (d, r)."""
    P, u = _weigh_about_mean(J, s, V)
    values, axes = np.linalg.eigh((P + np.swapaxes(P, 1, 2)) / 2.0)
    root = axes / np.sqrt(np.maximum(values, 1e-9))[:, None, :]
    return np.asarray(np.einsum("dij,dkj,dk->di", axes, root, u, optimize=True))


def _estimate_autocorrelation(residuals: Sequence[Array]) -> float:
    """Return the mean correlation of neighbouring days, zero if negative, at most 0.9.

    Residuals about a mean of d days have a correlation of about -1 / d by themselves.
    """
    product = sum(float(np.sum(e[1:] * e[:-1])) for e in residuals)
    square = sum(float(np.sum(e * e)) for e in residuals)
    if square <= 0.0:
        return 0.0
    days = sum(len(e) for e in residuals) / len(residuals)
    return float(np.clip(product / square + 1.0 / days, 0.0, 0.9))


def _fit_temperature(histories: Sequence[History]) -> Array:
    """Return the change by a unit of temperature (c, r), pooled over robots; empty without any."""
    c = histories[0].covariates.shape[1]
    r = histories[0].score.shape[1]
    rows = [np.zeros((0, c))]
    targets = [np.zeros((0, r))]
    for history in histories:
        known = np.isfinite(history.covariates).all(axis=1)
        if known.sum() >= 3:
            rows.append(np.diff(history.covariates[known], axis=0))
            targets.append(np.diff(history.estimates[known], axis=0))
    X = np.concatenate(rows)
    Y = np.concatenate(targets)
    if len(X) < 10 * c or not np.any(X):
        return np.zeros((0, r))
    scale = np.maximum(1.4826 * np.median(np.abs(Y), axis=0), 1e-12)
    weight = 1.0 / np.maximum(np.max(np.abs(Y) / scale, axis=1) / 4.0, 1.0)
    return np.asarray(np.linalg.lstsq(X * weight[:, None], Y * weight[:, None], rcond=None)[0])


DRAWS = 4000
"""Simulated histories without a change."""
FEWEST_HISTORIES = 12
"""Shuffled histories below which the theoretical distribution is used."""
MOST_DEGREES = 2.0
"""Most degrees of freedom fitted, in the number of directions."""
RESOLVED = 40
"""Rank among them below which the simulation is not used."""


DAYS_BEFORE = 3
"""Fewest days before a change."""
DAYS_AFTER = 2
"""Fewest days from a change on."""


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
    p_value
        Probability of as large a one without a change.
    """

    statistics: Array
    candidates: Array
    place: int
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
    candidates = np.arange(max(DAYS_BEFORE, first), d - DAYS_AFTER + 1)
    if not candidates.size:
        return None
    P, b = _weigh_days(information, score, variation)
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
        scan_probability(single, d, r, int(candidates[0])) ** known.power,
    )


def scan_probability(single: float, d: int, r: int, first: int = DAYS_BEFORE) -> float:
    """Return the probability of so small a least p-value over all candidates of d days.

    Simulated without a change where simulations resolve it; below, the sum over the candidates
    (Bonferroni), which bounds it.
    """
    least = _draw_least_probabilities(d, r, first)
    bound = (d - DAYS_AFTER + 1 - first) * single
    rank = int(np.searchsorted(least, single, side="right"))
    if rank >= RESOLVED:
        return float(min((rank + 1.0) / (DRAWS + 1.0), bound, 1.0))
    return float(min(bound, (RESOLVED + 1.0) / (DRAWS + 1.0)))


@lru_cache(maxsize=256)
def _draw_least_probabilities(d: int, r: int, first: int) -> Array:
    """Return the least p-values of histories without a change, sorted, (DRAWS,)."""
    rng = np.random.default_rng(0)
    candidates = np.arange(first, d - DAYS_AFTER + 1)
    largest = []
    for _ in range(8):
        sums = np.cumsum(rng.standard_normal((DRAWS // 8, d, r)), axis=1)
        bridge = sums[:, candidates - 1] - candidates[:, None] / d * sums[:, -1:]
        size = np.sum(bridge**2, axis=2) / (candidates * (d - candidates) / d)
        largest.append(size.max(axis=1))
    found = np.sort(np.asarray(chdtrc(r, np.concatenate(largest))))
    found.setflags(write=False)
    return found
