"""Tolerances of CAD for every link, and a test of differences against them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description import LinkInertia, RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import UsageError
from asbuilt.identification.uncertainty.block_scatter import (
    mean_degrees,
    student_probability,
    sum_degrees,
    widening,
)
from asbuilt.validation.comparison.significance import (
    ChiSquare,
    benjamini_hochberg,
    chi_square,
)

WIDEST = 100.0
"""Largest factor on the tolerances that is tried."""
NODES = ((-np.sqrt(3.0), 1.0 / 6.0), (0.0, 2.0 / 3.0), (np.sqrt(3.0), 1.0 / 6.0))
"""Nodes and weights of the Gauss-Hermite rule with three nodes, exact to the fifth degree."""


@dataclass(frozen=True, slots=True)
class CadTolerance:
    """State the tolerances of CAD for every link, as standard deviations.

    `mass` and `inertia` are fractions of the mass and of the mean moment about the centre of mass;
    `centre` holds for each coordinate of the centre, as a fraction of the radius of gyration.
    """

    mass: float = 0.05
    centre: float = 0.05
    inertia: float = 0.05

    def __post_init__(self) -> None:
        for what in ("mass", "centre", "inertia"):
            value = getattr(self, what)
            if not 0.0 <= value < np.inf:
                raise UsageError(
                    "a tolerance of CAD must be a fraction of at least 0, such as 0.05 or 5%, got"
                    f" {value:g} for {what}"
                )

    @classmethod
    def parse(cls, text: str) -> CadTolerance:
        """Read `5%`, or three of them for mass, centre and inertia.

        >>> CadTolerance.parse("2%,0.05,10 %")
        CadTolerance(mass=0.02, centre=0.05, inertia=0.1)
        """
        try:
            values = [
                float(part.strip().removesuffix("%"))
                / (100.0 if part.strip().endswith("%") else 1.0)
                for part in text.split(",")
            ]
        except ValueError:
            values = []
        # A number above 1 is a percentage without its sign.
        if len(values) not in (1, 3) or any(value >= 1.0 for value in values):
            raise UsageError(
                "a tolerance of CAD is one fraction below 1, such as 5% or 0.05, or three for"
                f" mass, centre of mass and inertia; got {text!r}"
            )
        return cls(*(values * 3 if len(values) == 1 else values))

    def covariance(self, model: RobotModel, base: BaseParameters) -> Array:
        """Return the covariance (p, p) of the base parameters by design for independent links."""
        spread = np.zeros((base.n_standard, base.n_standard))
        for i, link in enumerate(model.links):
            # Links without mass have no tolerance: CAD says nothing of them.
            if link.inertia.mass > 0:
                own = slice(10 * i, 10 * i + 10)
                spread[own, own] = self._mean_square(link.inertia)
        K = base.regrouping
        return np.asarray(K @ spread @ K.T)

    def _mean_square(self, inertia: LinkInertia) -> Array:
        """Return the mean square (10, 10) of the change of a link's parameters.

        Mass times two coordinates of the centre, squared, is of fourth degree in each variable, so
        three Gauss-Hermite nodes are exact; the inertia about the centre adds its own.
        """
        moment = float(np.trace(inertia.inertia_about_com))
        # Radius of gyration from the trace of the inertia about the centre.
        gyration = np.sqrt(max(moment, 0.0) / (2.0 * inertia.mass))
        places, weights = (
            np.array(list(product(*[axis] * 4))) for axis in zip(*NODES, strict=True)
        )
        mass = inertia.mass * (1.0 + self.mass * places[:, 0])
        # Nodes of mass and three coordinates of the centre.
        centre = inertia.com + self.centre * gyration * places[:, 1:]
        about_origin = np.einsum("s,sc,sc->s", mass, centre, centre)[:, None, None] * np.eye(
            3
        ) - np.einsum("s,sa,sb->sab", mass, centre, centre)
        about_origin += inertia.inertia_about_com
        upper = np.triu_indices(3)
        moved = (
            # Parallel axes: the inertia about the origin changes with mass and centre.
            np.column_stack([about_origin[:, upper[0], upper[1]], mass[:, None] * centre, mass])
            - inertia.parameters
        )
        found = moved.T @ (weights.prod(axis=1)[:, None] * moved)
        # Moments alone: axes of the inertia are taken as CAD's.
        found[range(6), range(6)] += (self.inertia * moment / 3.0) ** 2
        return np.asarray(found)

    def scaled(self, factor: float) -> CadTolerance:
        """Return tolerances that are all `factor` times these."""
        return CadTolerance(factor * self.mass, factor * self.centre, factor * self.inertia)


def check_tolerance(
    tolerance: CadTolerance,
    model: RobotModel,
    base: BaseParameters,
    difference: ArrayLike,
    covariance: ArrayLike,
    tested: ArrayLike,
    *,
    level: float,
    degrees_of_freedom: ArrayLike,
) -> tuple[ChiSquare, float | None, tuple[str, ...]]:
    """Test differences from CAD (p,) with their covariance (p, p) against tolerances.

    `tested` (p,) selects parameters; `degrees_of_freedom` (p,) belong to the variances, which are
    widened for them. Returned are the test, the factor on the tolerances that covers the
    differences, None if 1 does or none up to `WIDEST`, and the parameters that exceed theirs.
    """
    chosen = np.flatnonzero(np.asarray(tested))
    d = np.asarray(difference, dtype=np.float64)[chosen]
    own = np.ix_(chosen, chosen)
    freedom = np.asarray(degrees_of_freedom, dtype=np.float64)[chosen]
    # Variances as estimated, before the widening for few blocks.
    wide = widening(freedom)
    sampled = np.asarray(covariance, dtype=np.float64)[own] / np.outer(wide, wide)

    def claimed(factor: float) -> Array:
        return np.asarray(sampled + tolerance.scaled(factor).covariance(model, base)[own])

    def degrees_of(whole: Array) -> Array:
        own = np.diag(sampled)
        known = np.diag(whole) - own
        # Tolerances are known, so that they have no end of freedom.
        return sum_degrees((own, freedom), (known, np.full(len(d), np.inf)))

    def together(factor: float) -> ChiSquare:
        whole = claimed(factor)
        return chi_square(d, whole, mean_degrees(degrees_of(whole)))

    held = together(1.0)
    whole = claimed(1.0)
    of_each = degrees_of(whole)
    error = np.sqrt(np.diag(whole))
    exceeded = (
        benjamini_hochberg(student_probability(d / (error * widening(of_each)), of_each)) <= level
    )
    needed = None
    if held.probability <= level:
        needed = _find_widening(lambda factor: together(factor).probability - level)
    return held, needed, tuple(base.names[j] for j in chosen[exceeded])


def _find_widening(excess: Callable[[float], float]) -> float | None:
    """Return the factor from 1 to `WIDEST` at which the excess is zero; None where none covers."""
    from scipy.optimize import brentq  # noqa: PLC0415 - light start

    return float(brentq(excess, 1.0, WIDEST, rtol=1e-3)) if excess(WIDEST) > 0 else None
