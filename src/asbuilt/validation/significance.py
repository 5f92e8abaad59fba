"""Many tests at once, the test of a whole vector, and what CAD itself claims to know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, ndtr

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import BaseParameters
from asbuilt.errors import UsageError

Array = NDArray[np.float64]

SMALLEST_EIGENVALUE = 1e-10
"""Eigenvalue of a correlation matrix, relative to the largest, that counts as zero."""


def two_sided_probability(sigmas: ArrayLike) -> Array:
    """Return the probability of a normal variable at least so many standard deviations off.

    >>> float(np.round(two_sided_probability(1.96), 3))
    0.05
    """
    return np.asarray(2.0 * ndtr(-np.abs(np.asarray(sigmas, dtype=np.float64))))


def benjamini_hochberg(probabilities: ArrayLike) -> Array:
    """Return the false discovery rate at which each hypothesis would be the last to be rejected: `min_{j >= i} m p_(j) / j`.

    Among hypotheses with a value of at most 0.05, 5 % are expected to be rejected wrongly (Benjamini & Hochberg, J. Royal Stat. Soc. B 57, 1995).

    >>> benjamini_hochberg([0.01, 0.04, 0.03]).round(3).tolist()
    [0.03, 0.04, 0.04]
    """
    p = np.asarray(probabilities, dtype=np.float64)
    order = np.argsort(p)
    stepped = np.minimum.accumulate((p[order] * len(p) / np.arange(1, len(p) + 1))[::-1])[::-1]
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


def holm(probabilities: ArrayLike) -> Array:
    """Return probabilities adjusted so that a single wrong rejection among all is as likely as stated: `max_{j <= i} (m - j + 1) p_(j)`.

    Source: Holm, Scandinavian J. Statistics 6, 1979.

    >>> holm([0.01, 0.04, 0.03]).round(3).tolist()
    [0.03, 0.06, 0.06]
    """
    p = np.asarray(probabilities, dtype=np.float64)
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


@dataclass(frozen=True, slots=True)
class ChiSquare:
    """Hold a Wald statistic `d^T C^+ d`, its degrees of freedom (the rank of C) and the probability of as much if nothing differed."""

    statistic: float
    degrees: int
    probability: float


def chi_square(difference: ArrayLike, covariance: ArrayLike) -> ChiSquare:
    """Test whether a whole vector of differences (p,) is zero, given its covariance (p, p), singular or not (Wald, 1943).

    >>> test = chi_square([2.0, 0.0], np.eye(2))
    >>> test.statistic, test.degrees, round(test.probability, 3)
    (4.0, 2, 0.135)
    """
    d, C = np.asarray(difference, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    size = np.sqrt(np.diag(C))
    told = size > 0
    if not told.any():
        return ChiSquare(0.0, 0, 1.0)
    size = size[told]
    eigenvalues, vectors = np.linalg.eigh(C[np.ix_(told, told)] / np.outer(size, size))
    kept = eigenvalues > SMALLEST_EIGENVALUE * eigenvalues[-1]
    whitened = (vectors[:, kept].T @ (d[told] / size)) / np.sqrt(eigenvalues[kept])
    statistic = float(whitened @ whitened)
    return ChiSquare(statistic, int(kept.sum()), float(chdtrc(int(kept.sum()), statistic)))


@dataclass(frozen=True, slots=True)
class CadTolerance:
    """State how well CAD is believed to know every link, one standard deviation.

    `mass` and `inertia` are fractions of the mass and of the mean moment about the centre; `centre` is how far the centre of mass may be off along each axis, as
    a fraction of the radius of gyration about it.
    """

    mass: float = 0.05
    centre: float = 0.05
    inertia: float = 0.05

    def __post_init__(self) -> None:
        for what in ("mass", "centre", "inertia"):
            value = getattr(self, what)
            if not 0.0 <= value < 1.0:
                raise UsageError(f"a tolerance of CAD must lie between 0 and 1 (0 % and 100 %), got {value:g} for {what}")

    @classmethod
    def parse(cls, text: str) -> CadTolerance:
        """Read `5%`, or three of them for mass, centre and inertia.

        >>> CadTolerance.parse("2%,0.05,10 %")
        CadTolerance(mass=0.02, centre=0.05, inertia=0.1)
        """
        try:
            values = [float(part.strip().removesuffix("%")) / (100.0 if part.strip().endswith("%") else 1.0) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (1, 3):
            raise UsageError(f"a tolerance of CAD is one fraction such as 5%, or three for mass, centre of mass and inertia; got {text!r}")
        return cls(*(values * 3 if len(values) == 1 else values))

    def covariance(self, model: RobotModel, base: BaseParameters) -> Array:
        """Return the covariance (p, p) of the base parameters by design that the tolerances of all links, independent, make."""
        spread = np.zeros((base.n_standard, base.n_standard))
        for i, link in enumerate(model.links):
            mass = link.inertia.mass
            if mass <= 0:
                continue
            J = jacobian_about_centre(link.inertia)
            about_com = link.inertia.inertia_about_com
            gyration = float(np.sqrt(max(np.trace(about_com), 0.0) / (2.0 * mass)))
            scale = float(np.trace(about_com)) / 3.0
            sigma = np.concatenate([np.full(6, self.inertia * scale), np.full(3, self.centre * gyration), [self.mass * mass]])
            own = slice(10 * i, 10 * i + 10)
            spread[own, own] = (J * sigma**2) @ J.T
        K = base.regrouping
        return np.asarray(K @ spread @ K.T)


def jacobian_about_centre(inertia: LinkInertia) -> Array:
    """Return how the ten parameters about the link origin move with inertia about the centre (6), centre (3) and mass (1), shape (10, 10)."""
    mass, com = inertia.mass, inertia.com
    about = inertia.inertia_about_com
    upper = np.triu_indices(3)

    def parameters(moments: Array, centre: Array, m: float) -> Array:
        full = np.zeros((3, 3))
        full[upper] = moments
        return np.asarray(LinkInertia.from_com(m, centre, full + np.triu(full, 1).T).parameters)

    at = np.concatenate([about[upper], com, [mass]])
    columns = []
    for j in range(10):
        step = np.zeros(10)
        step[j] = 1e-6 * max(1e-3, abs(at[j]))
        high, low = at + step, at - step
        columns.append((parameters(high[:6], high[6:9], high[9]) - parameters(low[:6], low[6:9], low[9])) / (2.0 * step[j]))
    return np.column_stack(columns)
