"""Many tests at once, the test of a whole vector, and what CAD itself claims to know."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, ndtr

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base_parameters import BaseParameters
from asbuilt.errors import UsageError

Array = NDArray[np.float64]

NODES = ((-np.sqrt(3.0), 1.0 / 6.0), (0.0, 2.0 / 3.0), (np.sqrt(3.0), 1.0 / 6.0))
"""Places and weights that give the mean of a polynomial of fifth degree in a standard normal variable (Gauss and Hermite)."""

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


def size_probability(vector: ArrayLike, covariance: ArrayLike) -> float:
    """Return the probability that a normal vector of mean zero and this covariance (m, m) is as long as `vector` (m,), or longer.

    The squared length is a sum of chi-square variables with the eigenvalues as weights; one scaled chi-square variable of the same mean and variance stands in for it
    (Satterthwaite, Biometrics Bulletin 2, 1946).

    >>> round(size_probability([1.96], [[1.0]]), 3)
    0.05
    """
    v, C = np.asarray(vector, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    mean, square = float(np.trace(C)), float(np.sum(C**2))
    if mean <= 0.0:
        return 0.0 if v.any() else 1.0
    return float(chdtrc(mean**2 / square, float(v @ v) * mean / square))


def probability_text(p: float) -> str:
    """Return a probability with two digits, in words where it is too small for a number."""
    return "below 1e-300" if p < 1e-300 else f"{p:.2g}"


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
            if not 0.0 <= value < np.inf:
                raise UsageError(f"a tolerance of CAD must be a fraction of at least 0, such as 0.05 or 5%, got {value:g} for {what}")

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
        if len(values) not in (1, 3) or any(value >= 1.0 for value in values):
            raise UsageError(
                f"a tolerance of CAD is one fraction below 1, such as 5% or 0.05, or three for mass, centre of mass and inertia; got {text!r}"
            )
        return cls(*(values * 3 if len(values) == 1 else values))

    def covariance(self, model: RobotModel, base: BaseParameters) -> Array:
        """Return the mean square (p, p) of what the tolerances of all links, independent and normal, do to the base parameters by design."""
        spread = np.zeros((base.n_standard, base.n_standard))
        for i, link in enumerate(model.links):
            if link.inertia.mass > 0:
                own = slice(10 * i, 10 * i + 10)
                spread[own, own] = self._mean_square(link.inertia)
        K = base.regrouping
        return np.asarray(K @ spread @ K.T)

    def _mean_square(self, inertia: LinkInertia) -> Array:
        """Return the mean square (10, 10) of the change of a link's parameters, exact: a product of mass and two coordinates of the centre, squared, is of fourth degree in each.

        Gauss and Hermite's rule with three nodes for mass and each coordinate of the centre; the inertia about the centre adds its own.
        """
        moment = float(np.trace(inertia.inertia_about_com))
        gyration = np.sqrt(max(moment, 0.0) / (2.0 * inertia.mass))
        places, weights = (np.array(list(product(*[axis] * 4))) for axis in zip(*NODES, strict=True))
        mass = inertia.mass * (1.0 + self.mass * places[:, 0])
        centre = inertia.com + self.centre * gyration * places[:, 1:]
        about_origin = np.einsum("s,sc,sc->s", mass, centre, centre)[:, None, None] * np.eye(3) - np.einsum(
            "s,sa,sb->sab", mass, centre, centre
        )
        about_origin += inertia.inertia_about_com
        upper = np.triu_indices(3)
        moved = np.column_stack([about_origin[:, upper[0], upper[1]], mass[:, None] * centre, mass]) - inertia.parameters
        found = moved.T @ (weights.prod(axis=1)[:, None] * moved)
        found[range(6), range(6)] += (self.inertia * moment / 3.0) ** 2
        return np.asarray(found)

    def scaled(self, factor: float) -> CadTolerance:
        """Return tolerances that are all `factor` times these."""
        return CadTolerance(factor * self.mass, factor * self.centre, factor * self.inertia)
