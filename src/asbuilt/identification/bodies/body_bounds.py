"""Bounds on what bodies and drives may be: masses, centres of mass, friction and armature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.errors import UsageError
from asbuilt.identification.bodies.cad_prior import CadPrior

LIGHTEST = 0.05
"""Smallest mass of a link by default, as a fraction of its CAD mass,"""
HEAVIEST = 10.0
"""and largest, unless all links together weigh more: then that."""
FARTHEST = 2.0
"""How far a centre of mass may lie from that of CAD by default, along each axis, in multiples of
the largest reach of a link.
"""


@dataclass(frozen=True, eq=False)
class BodyBounds:
    """Hold linear bounds `rows @ chi + offsets >= 0` on the standard parameters.

    `labels` say each in words.
    """

    rows: Array
    offsets: Array
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        self.rows.setflags(write=False)
        self.offsets.setflags(write=False)

    def slack(self, chi: ArrayLike) -> Array:
        """Return how much room every bound leaves; negative where it is broken."""
        return np.asarray(self.rows @ np.asarray(chi, dtype=np.float64) + self.offsets)

    def and_also(self, other: BodyBounds) -> BodyBounds:
        """Return both sets of bounds together."""
        return BodyBounds(
            np.vstack([self.rows, other.rows]),
            np.concatenate([self.offsets, other.offsets]),
            self.labels + other.labels,
        )


def non_negative_drives(prior: CadPrior) -> BodyBounds:
    """Return the bounds every drive obeys: armature, viscous and Coulomb friction are not negative."""
    rows = np.zeros((len(prior.non_negative), len(prior.parameters)))
    rows[np.arange(len(rows)), prior.non_negative] = 1.0
    return BodyBounds(
        rows, np.zeros(len(rows)), tuple(f"{prior.names[j]} >= 0" for j in prior.non_negative)
    )


def generous_bounds(prior: CadPrior) -> BodyBounds:
    """Return bounds that only exclude the absurd.

    Non-negative drives, masses within a factor of CAD, centres of mass near the robot.

    A link weighs from a twentieth to ten times its CAD mass (or as much as all links), and its
    centre of mass lies within two reaches of that of CAD.
    """
    bodies = prior.parameters[: 10 * prior.n_links].reshape(-1, 10)
    total = float(bodies[:, 9].sum())
    far = FARTHEST * float(prior.reach.max())
    masses = {
        i: (LIGHTEST * body[9], max(HEAVIEST * body[9], total)) for i, body in enumerate(bodies)
    }
    centres = {
        i: (body[6:9] / body[9] - far, body[6:9] / body[9] + far) for i, body in enumerate(bodies)
    }
    return non_negative_drives(prior).and_also(body_bounds(prior, mass=masses, com=centres))


def body_bounds(
    prior: CadPrior,
    *,
    mass: Mapping[int, tuple[float, float]] | None = None,
    com: Mapping[int, tuple[Sequence[float] | Array, Sequence[float] | Array]] | None = None,
) -> BodyBounds:
    """Return bounds on the mass [kg] and the centre of mass [m, link axes] of links, counted from
    0: (lower, upper) each.

    Raises `UsageError` for links that do not exist and for a lower bound above its upper one.
    """
    rows: list[Array] = []
    offsets: list[float] = []
    labels: list[str] = []

    def at_least(link: int, coefficients: Mapping[int, float], offset: float, label: str) -> None:
        row = np.zeros(len(prior.parameters))
        for place, factor in coefficients.items():
            row[10 * link + place] = factor
        rows.append(row)
        offsets.append(offset)
        labels.append(label)

    for link, (lower, upper) in (mass or {}).items():
        _check(prior, link, lower, upper, "mass")
        at_least(link, {9: 1.0}, -float(lower), f"m{link + 1} >= {lower:.3g} kg")
        if np.isfinite(upper):
            at_least(link, {9: -1.0}, float(upper), f"m{link + 1} <= {upper:.3g} kg")
    for link, (low, high) in (com or {}).items():
        for axis in range(3):
            _check(prior, link, low[axis], high[axis], f"centre of mass along {'xyz'[axis]}")
            at_least(
                link,
                {6 + axis: 1.0, 9: -float(low[axis])},
                0.0,
                f"c{'xyz'[axis]}{link + 1} >= {low[axis]:.3g} m",
            )
            at_least(
                link,
                {6 + axis: -1.0, 9: float(high[axis])},
                0.0,
                f"c{'xyz'[axis]}{link + 1} <= {high[axis]:.3g} m",
            )
    return BodyBounds(
        np.array(rows).reshape(-1, len(prior.parameters)), np.array(offsets), tuple(labels)
    )


def _check(prior: CadPrior, link: int, lower: float, upper: float, what: str) -> None:
    if not 0 <= link < prior.n_links:
        raise UsageError(
            f"{prior.robot} has links 0 to {prior.n_links - 1}, got a bound for link {link}"
        )
    if not lower <= upper:
        raise UsageError(
            f"{what} of link {link} of {prior.robot} is bounded by {lower} and {upper}; give the"
            " lower bound first"
        )
