"""Linear bounds on masses, centres of mass, friction and armature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.errors import UsageError
from asbuilt.identification.bodies.cad_prior import CadPrior


@dataclass(frozen=True, eq=False)
class BodyBounds:
    """Hold linear bounds `rows @ chi + offsets >= 0` on the standard parameters, with labels."""

    rows: Array
    offsets: Array
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        self.rows.setflags(write=False)
        self.offsets.setflags(write=False)

    def slack(self, chi: ArrayLike) -> Array:
        """Return the slack of every bound; negative if it is violated."""
        return np.asarray(self.rows @ np.asarray(chi, dtype=np.float64) + self.offsets)

    def wider(self, part: float, chi: ArrayLike) -> BodyBounds:
        """Return the bounds wider by a part of the size of their terms at chi: rounding."""
        size = np.abs(self.rows) @ np.abs(np.asarray(chi)) + np.abs(self.offsets)
        return BodyBounds(self.rows.copy(), self.offsets + part * size, self.labels)

    def raised(self, below: ArrayLike) -> BodyBounds:
        """Return these bounds as bounds on `chi - below`."""
        return BodyBounds(self.rows.copy(), self.slack(below), self.labels)

    def and_also(self, other: BodyBounds) -> BodyBounds:
        """Return both sets of bounds together."""
        return BodyBounds(
            np.vstack([self.rows, other.rows]),
            np.concatenate([self.offsets, other.offsets]),
            self.labels + other.labels,
        )


def bound_passive_drives(prior: CadPrior) -> BodyBounds:
    """Return the bounds of passive drives: armature and friction are not negative."""
    rows = np.zeros((len(prior.non_negative), len(prior.parameters)))
    rows[np.arange(len(rows)), prior.non_negative] = 1.0
    return BodyBounds(
        rows, np.zeros(len(rows)), tuple(f"{prior.names[j]} >= 0" for j in prior.non_negative)
    )


def bound_known_masses(prior: CadPrior) -> BodyBounds:
    """Return the bounds of masses that are known in addition to CAD, such as from a scale."""
    rows: list[Array] = []
    offsets: list[float] = []
    labels: list[str] = []
    for links, lower, upper in prior.mass_ranges:
        row = np.zeros(len(prior.parameters))
        row[[10 * link + 9 for link in links]] = 1.0
        name = " + ".join(f"m{link + 1}" for link in links)
        if len(links) > 2 and links == tuple(range(links[0], links[-1] + 1)):
            name = f"m{links[0] + 1} + ... + m{links[-1] + 1}"
        if lower > 0.0:
            rows, offsets = [*rows, row], [*offsets, -lower]
            labels.append(f"{name} >= {lower:.4g} kg (given)")
        if np.isfinite(upper):
            rows, offsets = [*rows, -row], [*offsets, upper]
            labels.append(f"{name} <= {upper:.4g} kg (given)")
    return BodyBounds(
        np.array(rows).reshape(-1, len(prior.parameters)), np.array(offsets), tuple(labels)
    )


def bound_with_certainty(prior: CadPrior) -> BodyBounds:
    """Return the bounds of passive drives and of known masses."""
    return bound_passive_drives(prior).and_also(bound_known_masses(prior))


def bound_generously(prior: CadPrior) -> BodyBounds:
    """Return bounds that are certain, and masses and centres of mass of the order of CAD."""
    return bound_with_certainty(prior).and_also(bound_widely(prior))


def bound_widely(prior: CadPrior) -> BodyBounds:
    """Return bounds of masses and centres of mass of the order of CAD.

    A link has 0.05 to 10 times its CAD mass (or the mass of all links) unless its own is known, and
    its centre of mass is within two reaches of the CAD value.
    """
    given = {links[0] for links, _, _ in prior.mass_ranges if len(links) == 1}
    bodies = prior.parameters[: 10 * prior.n_links].reshape(-1, 10)
    total = float(bodies[:, 9].sum())
    # Default bound of a centre of mass along each axis from its CAD value, in reaches of a link.
    far = 2.0 * float(prior.reach.max())
    # 0.05: default lower bound of the mass of a link, in CAD masses.
    # 10.0: default upper bound of the mass of a link, in CAD masses; at least the mass of all
    # links.
    masses = {
        i: (0.05 * body[9], max(10.0 * body[9], total))
        for i, body in enumerate(bodies)
        if i not in given
    }
    centres = {
        i: (body[6:9] / body[9] - far, body[6:9] / body[9] + far) for i, body in enumerate(bodies)
    }
    return bound_bodies(prior, mass=masses, com=centres)


def bound_bodies(
    prior: CadPrior,
    *,
    mass: Mapping[int, tuple[float, float]] | None = None,
    com: Mapping[int, tuple[Sequence[float] | Array, Sequence[float] | Array]] | None = None,
) -> BodyBounds:
    """Return bounds on the mass and the centre of mass of links.

    Parameters
    ----------
    prior
        CAD values of the robot.
    mass
        Lower and upper bound [kg] by link, counted from 0.
    com
        Lower and upper bounds [m] in link axes, three values each, by link.

    Raises
    ------
    UsageError
        If a link does not exist, or a lower bound exceeds its upper bound.
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
            f"link {link} has bounds but does not exist; {prior.robot} has links 0 to"
            f" {prior.n_links - 1}"
        )
    if not lower <= upper:
        raise UsageError(
            f"bounds of the {what} of link {link} of {prior.robot} are {lower} and {upper};"
            " expected the lower bound first"
        )
