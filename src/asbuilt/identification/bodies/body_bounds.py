"""Linear bounds on masses, centres of mass, friction and armature."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Cure
from asbuilt.identification.bodies.cad_prior import CadPrior
from asbuilt.registry import Registry

Bound = tuple[Mapping[int, float], float, str]
"""Coefficients of standard parameters by place, an offset, and a label."""


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
        return self.rows @ np.asarray(chi, dtype=np.float64) + self.offsets

    def wider(self, part: float, chi: ArrayLike) -> BodyBounds:
        """Return the bounds wider by a part of the size of their terms at chi: rounding."""
        # The size of the terms, not of their sum: rounding is left where they cancel.
        size = np.abs(self.rows) @ np.abs(np.asarray(chi)) + np.abs(self.offsets)
        return BodyBounds(self.rows.copy(), self.offsets + part * size, self.labels)

    def raised(self, below: ArrayLike) -> BodyBounds:
        """Return these bounds as bounds on `chi - below`."""
        # rows (chi - below) + (offsets + rows below) >= 0
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
    passive = prior.non_negative.tolist()
    return _join_bounds(prior, [({j: 1.0}, 0.0, f"{prior.names[j]} >= 0") for j in passive])


def bound_known_masses(prior: CadPrior) -> BodyBounds:
    """Return the bounds of masses that are known in addition to CAD, such as from a scale."""
    bounds: list[Bound] = []
    for links, lower, upper in prior.mass_ranges:
        masses = [10 * link + 9 for link in links]
        name = " + ".join(f"m{link + 1}" for link in links)
        # A whole robot's links would fill the message.
        if len(links) > 2 and links == tuple(range(links[0], links[-1] + 1)):
            name = f"m{links[0] + 1} + ... + m{links[-1] + 1}"
        if lower > 0.0:
            label = f"{name} >= {lower:.4g} kg (given)"
            bounds.append((dict.fromkeys(masses, 1.0), -lower, label))
        if np.isfinite(upper):
            label = f"{name} <= {upper:.4g} kg (given)"
            bounds.append((dict.fromkeys(masses, -1.0), upper, label))
    return _join_bounds(prior, bounds)


def bound_with_certainty(prior: CadPrior) -> BodyBounds:
    """Return the bounds of passive drives and of known masses."""
    return bound_passive_drives(prior).and_also(bound_known_masses(prior))


LINK_SHAPES: Registry[Callable[[RobotModel], Mapping[int, tuple[Array, Array]]]] = Registry(
    "reader of link shapes", None, "asbuilt.link_shapes"
)
"""Functions that give the corners (3,) of the box around each link that has shapes, by number."""
STEEL = 7850.0
"""Density of steel [kg/m^3], the heaviest material of which links are made throughout."""


def bound_stated(
    prior: CadPrior, model: RobotModel, tolerance: float | None, *, geometry: bool
) -> BodyBounds:
    """Return bounds that a user states: masses near CAD, and bodies within their shapes.

    Parameters
    ----------
    prior, model
        CAD values, and the robot as described.
    tolerance
        Largest relative error of a CAD mass; None: masses are not bounded by CAD.
    geometry
        Whether the mass of a link lies within the box around the shapes of the description, and no
        part of it is denser than steel. With corners l and u, `integral (x - l)(u - x) dm >= 0`
        along each axis, and the centre of mass is between l and u.

    Raises
    ------
    UsageError
        If the tolerance is not positive.
    DescriptionError
        If the description has no shapes.
    """
    bounds = _join_bounds(prior, [])
    if tolerance is not None:
        if not tolerance > 0.0:
            raise UsageError(f"a tolerance of CAD is positive, such as 0.2; got {tolerance:g}")
        # A link whose mass is guessed, as CAD has none, has less weight than the others.
        masses = {
            i: (max(1.0 - tolerance, 0.0) * mass, (1.0 + tolerance) * mass)
            for i, mass in enumerate(prior.parameters[9 : 10 * prior.n_links : 10].tolist())
            if prior.strength[i] == 1.0
        }
        bounds = bounds.and_also(bound_bodies(prior, mass=masses))
    return bounds.and_also(_bound_by_shapes(prior, model)) if geometry else bounds


def _bound_by_shapes(prior: CadPrior, model: RobotModel) -> BodyBounds:
    """Return the bounds of links by the shapes of their description."""
    bounds = list[Bound]()
    for k, (lower, upper) in LINK_SHAPES.find("urdf")(model).items():
        link = model.links[k]
        first = 10 * k
        m = 10 * k + 9
        heaviest = STEEL * float(np.prod(upper - lower))
        bounds.append(({m: -1.0}, heaviest, f"m{k + 1} <= {heaviest:.3g} kg (steel)"))
        for axis, low, high in zip(range(3), lower.tolist(), upper.tolist(), strict=True):
            moment = first + 6 + axis
            label = f"{link.name} within its shapes along {'xyz'[axis]}"
            bounds.append(({moment: 1.0, m: -low}, 0.0, label))
            bounds.append(({moment: -1.0, m: high}, 0.0, label))
            # integral x^2 dm = (Iyy + Izz - Ixx) / 2, and so on.
            second = {first + place: 0.5 for place in (0, 3, 5)}
            second[first + (0, 3, 5)[axis]] = -0.5
            # integral (x - l)(u - x) dm = -integral x^2 dm + (l + u) m c - l u m
            spread = {place: -part for place, part in second.items()}
            bounds.append((spread | {moment: low + high, m: -low * high}, 0.0, label))
    if not bounds:
        raise DescriptionError(
            f"no link of {model.name} has shapes with a size, so geometry bounds nothing",
            cure=Cure("leave geometry out, or place the meshes next to the URDF"),
        )
    return _join_bounds(prior, bounds)


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
        # Twice the largest reach: joints and frames rarely enclose the whole body.
        i: (body[6:9] / body[9] - far, body[6:9] / body[9] + far)
        for i, body in enumerate(bodies)
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
    bounds: list[Bound] = []
    for link, (lower, upper) in (mass or {}).items():
        _check(prior, link, lower, upper, "mass")
        m = 10 * link + 9
        name = f"m{link + 1}"
        bounds.append(({m: 1.0}, -float(lower), f"{name} >= {lower:.3g} kg"))
        if np.isfinite(upper):
            bounds.append(({m: -1.0}, float(upper), f"{name} <= {upper:.3g} kg"))
    for link, centre in (com or {}).items():
        for axis, low, high in zip(range(3), *centre, strict=True):
            _check(prior, link, low, high, f"centre of mass along {'xyz'[axis]}")
            moment = 10 * link + 6 + axis
            m = 10 * link + 9
            name = f"c{'xyz'[axis]}{link + 1}"
            # m c >= low m, linear in the standard parameters.
            bounds.append(({moment: 1.0, m: -float(low)}, 0.0, f"{name} >= {low:.3g} m"))
            bounds.append(({moment: -1.0, m: float(high)}, 0.0, f"{name} <= {high:.3g} m"))
    return _join_bounds(prior, bounds)


def _join_bounds(prior: CadPrior, bounds: Sequence[Bound]) -> BodyBounds:
    """Return bounds that are given one by one."""
    rows = np.zeros((len(bounds), len(prior.parameters)))
    for row, (coefficients, _, _) in zip(rows, bounds, strict=True):
        # Many bounds have one or two coefficients each.
        row[[*coefficients]] = [*coefficients.values()]
    offsets = np.array([offset for _, offset, _ in bounds], dtype=np.float64)
    return BodyBounds(rows, offsets, tuple(label for _, _, label in bounds))


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
