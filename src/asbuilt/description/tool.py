"""A tool in a few words: a mass and where it is."""

from __future__ import annotations

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.errors import UsageError

DENSITY = 2700.0
"""Of aluminium [kg/m^3]: gives a tool its size."""


def tool_from_text(text: str) -> LinkInertia:
    """Return a ball of aluminium of mass `KG` centred at `X,Y,Z` [m].

    The text is `KG@X,Y,Z`, or `KG` alone for a ball at the origin.

    Raises `UsageError` for any other text.

    Examples
    --------
    >>> tool = tool_from_text("2.5@0,0,0.08")
    >>> tool.mass, tool.com.tolist()
    (2.5, [0.0, 0.0, 0.08])
    """
    weight, _, place = text.partition("@")
    try:
        mass = float(weight)
        com = [float(part) for part in place.split(",")] if place else [0.0, 0.0, 0.0]
    except ValueError:
        mass, com = np.nan, []
    if not (np.isfinite(mass) and mass > 0.0 and len(com) == 3 and np.all(np.isfinite(com))):
        raise UsageError(
            "a tool is KG@X,Y,Z: a positive mass and its centre in metres, for example"
            f" 2.5@0,0,0.08; got {text!r}"
        )
    radius = (0.75 * mass / (np.pi * DENSITY)) ** (1.0 / 3.0)
    return LinkInertia.from_com(mass, com, 0.4 * mass * radius**2 * np.eye(3))
