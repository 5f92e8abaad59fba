"""Masses known in addition to CAD, as from a scale: of the whole robot, or of single links."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace

from asbuilt.description.model import MassRange, RobotModel
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Cure

Limits = tuple[float, float]
"""Lower and upper limit of a mass [kg]."""

NUMBER = r"\d*\.?\d+(?:[eE][+-]?\d+)?"
WITHIN = re.compile(rf"(?P<mass>{NUMBER})\s*(?:\+/?-|±)\s*(?P<error>{NUMBER})")
BOUND = re.compile(rf"(?P<side><=|>=)\s*(?P<mass>{NUMBER})")
OF_LINK = re.compile(r"(?P<name>[^=<>]+?)\s*(?:=\s*(?P<within>[^=<>].*)|(?P<bound>[<>]=.*))")
EXAMPLE = Cure("write 18.6+-0.1, <=19 or >=18")


def limits_from_text(text: str) -> Limits:
    """Return the limits [kg] of `KG+-KG` (a mass and its error), `<=KG` or `>=KG`.

    Raises `UsageError` for any other text.

    >>> limits_from_text("18.5+-0.25"), limits_from_text("<=3")
    ((18.25, 18.75), (0.0, 3.0))
    """
    text = text.strip()
    if (found := WITHIN.fullmatch(text)) is not None:
        mass = float(found["mass"])
        error = float(found["error"])
        lower = max(mass - error, 0.0)
        upper = mass + error
    elif (found := BOUND.fullmatch(text)) is not None:
        mass = float(found["mass"])
        lower, upper = (0.0, mass) if found["side"] == "<=" else (mass, math.inf)
    else:
        raise UsageError(f"a known mass is KG+-KG, <=KG or >=KG; got {text!r}", cure=EXAMPLE)
    if not (lower < upper and math.isfinite(lower)):
        raise UsageError(
            f"a known mass needs an error above 0 and limits above 0 kg; got {text!r}", cure=EXAMPLE
        )
    return lower, upper


def total_mass_from_text(text: str) -> Limits:
    """Return the limits [kg] of all moving links of `KG+-KG` or `KG+-KG,root=KG`.

    The mass of the root link, if it was weighed too, is subtracted. Raises `UsageError` for any
    other text.

    >>> total_mass_from_text("24.5+-0.5,root=6")
    (18.0, 19.0)
    """
    whole, weighed_too, root = text.partition(",")
    lower, upper = limits_from_text(whole)
    if not weighed_too:
        return lower, upper
    name, _, mass = (part.strip() for part in root.partition("="))
    if name != "root" or re.fullmatch(NUMBER, mass) is None:
        raise UsageError(
            f"the mass of the root link follows the total as root=KG; got {root.strip()!r}",
            cure=Cure("write 24.5+-0.5,root=6"),
        )
    if not float(mass) < upper:
        raise UsageError(
            f"the root link alone has {mass} kg, which leaves no mass of {text!r} to the moving"
            " links"
        )
    return max(lower - float(mass), 0.0), upper - float(mass)


def link_masses_from_text(text: str) -> dict[str, Limits]:
    """Return the limits [kg] by link of `NAME=KG+-KG,NAME<=KG,...`.

    Limits of one link given twice both hold. Raises `UsageError` for any other text.

    >>> link_masses_from_text("hand=0.7+-0.1,arm<=3,arm>=2")
    {'hand': (0.6, 0.7999999999999999), 'arm': (2.0, 3.0)}
    """
    masses: dict[str, Limits] = {}
    for part in text.split(","):
        found = OF_LINK.fullmatch(part.strip())
        if found is None:
            raise UsageError(
                "masses of links are NAME=KG+-KG, NAME<=KG or NAME>=KG, separated by commas; got"
                f" {part.strip()!r}",
                cure=Cure("write hand=0.7+-0.05,link_1<=4"),
            )
        name = found["name"].strip()
        lower, upper = limits_from_text(found["within"] or found["bound"])
        # Both limits hold, so that the narrower counts.
        before = masses.get(name, (0.0, math.inf))
        masses[name] = (max(lower, before[0]), min(upper, before[1]))
        if not masses[name][0] < masses[name][1]:
            raise UsageError(
                f"the masses given of link {name} contradict each other: at least"
                f" {masses[name][0]:g} kg and at most {masses[name][1]:g} kg"
            )
    return masses


def with_known_masses(
    model: RobotModel, total: Limits | None, links: Mapping[str, Limits]
) -> RobotModel:
    """Return a robot with masses known in addition to its description.

    Parameters
    ----------
    model
        The robot as described.
    total
        Limits of the mass of all moving links together [kg]; None if unknown.
    links
        Limits of the masses of single moving links [kg] by name.

    Raises
    ------
    UsageError
        If there is no such moving link, or the limits of links contradict the total.
    """
    known = [MassRange((name,), *limits) for name, limits in links.items()]
    if total is not None:
        least = sum(known_mass.lower for known_mass in known)
        # One link without an upper limit leaves the whole unbounded.
        most = sum(links.get(name, (0.0, math.inf))[1] for name in model.link_names)
        if least >= total[1] or most <= total[0]:
            raise UsageError(
                f"the masses given of links ({least:g} to {most:g} kg together) contradict the mass"
                f" of all moving links of {model.name}: {total[0]:g} to {total[1]:g} kg"
            )
        known.append(MassRange(model.link_names, *total))
    if not known:
        return model
    try:
        return replace(model, mass_ranges=(*model.mass_ranges, *known))
    except DescriptionError as problem:
        # The description's own words name the place; the cure is the option's.
        raise UsageError(problem.message, cure=Cure("name moving links, or the total")) from None


def describe_known_masses(model: RobotModel) -> tuple[str, ...]:
    """Return a note that states the known masses, none if there are none."""
    if not model.mass_ranges:
        return ()
    stated = []
    for known in model.mass_ranges:
        name = known.links[0] if len(known.links) == 1 else f"{len(known.links)} links together"
        upper = f" to {known.upper:.4g}" if math.isfinite(known.upper) else " or more"
        stated.append(f"{name} {known.lower:.4g}{upper} kg")
    return (f"Masses given, which fit and export keep: {', '.join(stated)}",)
