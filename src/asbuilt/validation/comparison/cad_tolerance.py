"""What CAD itself claims to know of every link, and whether what was found is within it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import UsageError
from asbuilt.validation.comparison.significance import (
    ChiSquare,
    benjamini_hochberg,
    chi_square,
    two_sided_probability,
)

WIDEST = 100.0
"""Factor on the tolerances up to which it is sought how wide they would have to be."""
NODES = ((-np.sqrt(3.0), 1.0 / 6.0), (0.0, 2.0 / 3.0), (np.sqrt(3.0), 1.0 / 6.0))
"""Places and weights that give the mean of a polynomial of fifth degree in a standard normal
variable (Gauss and Hermite).
"""


@dataclass(frozen=True, slots=True)
class CadTolerance:
    """State how well CAD is believed to know every link, one standard deviation.

    `mass` and `inertia` are fractions of the mass and of the mean moment about the centre; `centre`
    is how far the centre of mass may be off along each axis, as a fraction of the radius of
    gyration about it.
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
        if len(values) not in (1, 3) or any(value >= 1.0 for value in values):
            raise UsageError(
                "a tolerance of CAD is one fraction below 1, such as 5% or 0.05, or three for"
                f" mass, centre of mass and inertia; got {text!r}"
            )
        return cls(*(values * 3 if len(values) == 1 else values))

    def covariance(self, model: RobotModel, base: BaseParameters) -> Array:
        """Return the mean square (p, p) of what the tolerances of all links, independent and
        normal, do to the base parameters by design.
        """
        spread = np.zeros((base.n_standard, base.n_standard))
        for i, link in enumerate(model.links):
            if link.inertia.mass > 0:
                own = slice(10 * i, 10 * i + 10)
                spread[own, own] = self._mean_square(link.inertia)
        K = base.regrouping
        return np.asarray(K @ spread @ K.T)

    def _mean_square(self, inertia: LinkInertia) -> Array:
        """Return the mean square (10, 10) of the change of a link's parameters, exact.

        A product of mass and two coordinates of the centre, squared, is of fourth degree in each.

        Gauss and Hermite's rule with three nodes for mass and each coordinate of the centre; the
        inertia about the centre adds its own.
        """
        moment = float(np.trace(inertia.inertia_about_com))
        gyration = np.sqrt(max(moment, 0.0) / (2.0 * inertia.mass))
        places, weights = (
            np.array(list(product(*[axis] * 4))) for axis in zip(*NODES, strict=True)
        )
        mass = inertia.mass * (1.0 + self.mass * places[:, 0])
        centre = inertia.com + self.centre * gyration * places[:, 1:]
        about_origin = np.einsum("s,sc,sc->s", mass, centre, centre)[:, None, None] * np.eye(
            3
        ) - np.einsum("s,sa,sb->sab", mass, centre, centre)
        about_origin += inertia.inertia_about_com
        upper = np.triu_indices(3)
        moved = (
            np.column_stack([about_origin[:, upper[0], upper[1]], mass[:, None] * centre, mass])
            - inertia.parameters
        )
        found = moved.T @ (weights.prod(axis=1)[:, None] * moved)
        found[range(6), range(6)] += (self.inertia * moment / 3.0) ** 2
        return np.asarray(found)

    def scaled(self, factor: float) -> CadTolerance:
        """Return tolerances that are all `factor` times these."""
        return CadTolerance(factor * self.mass, factor * self.centre, factor * self.inertia)


@dataclass(frozen=True, slots=True)
class ToleranceTest:
    """Hold what was found against tolerances of CAD.

    The test of all parameters at once, and `beyond`, the names of those that exceed theirs one by
    one.

    `needed` is the factor by which all tolerances would have to be wider to hold what was found,
    None where they hold it, or where none up to `WIDEST` is enough.
    """

    chi_square: ChiSquare
    needed: float | None
    beyond: tuple[str, ...]


def check_tolerance(
    tolerance: CadTolerance,
    model: RobotModel,
    base: BaseParameters,
    difference: ArrayLike,
    covariance: ArrayLike,
    tested: ArrayLike,
    *,
    level: float,
) -> ToleranceTest:
    """Test differences from CAD (p,), of that covariance (p, p), against what CAD claims to know.

    `tested` (p,) says which of the parameters take part.
    """
    chosen = np.flatnonzero(np.asarray(tested))
    d, own = np.asarray(difference, dtype=np.float64)[chosen], np.ix_(chosen, chosen)

    def claimed(factor: float) -> Array:
        return np.asarray(
            np.asarray(covariance)[own] + tolerance.scaled(factor).covariance(model, base)[own]
        )

    held = chi_square(d, claimed(1.0))
    exceeded = (
        benjamini_hochberg(two_sided_probability(d / np.sqrt(np.diag(claimed(1.0))))) <= level
    )
    return ToleranceTest(
        chi_square=held,
        needed=(
            None
            if held.probability > level
            else _widening(lambda factor: chi_square(d, claimed(factor)).probability - level)
        ),
        beyond=tuple(base.names[j] for j, out in zip(chosen, exceeded, strict=True) if out),
    )


def _widening(excess: Callable[[float], float]) -> float | None:
    """Return the factor from 1 to `WIDEST` at which the probability in excess of the level is zero,
    None where none is enough.
    """
    return float(brentq(excess, 1.0, WIDEST, rtol=1e-3)) if excess(WIDEST) > 0 else None
