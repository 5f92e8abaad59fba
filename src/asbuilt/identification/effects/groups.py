"""Parameters of a model by the effect that they belong to."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Indices
from asbuilt.dynamics import BaseParameters, DriveTerm
from asbuilt.identification.effects.effect import EFFECTS

LINKS = "links"
GROUPS: dict[str, str] = {
    "friction": "friction",
    "offset": "torque offset",
    "armature": "armature",
    LINKS: "mass distribution of the links",
}
"""Names of effects that are no family of their own, but parameters that every model has."""


def name_group(key: str) -> str:
    """Return the name of a group or an effect in sentences.

    >>> name_group("links"), name_group("tilt")
    ('mass distribution of the links', 'base tilt')
    """
    return GROUPS[key] if key in GROUPS else EFFECTS[key].title if key in EFFECTS else key


def find_group(term: DriveTerm) -> str:
    """Return the group of a drive term: what acts over position is an effect of its own."""
    return term.cause or (term.key if term.by_position else "friction")


def find_places(base: BaseParameters, key: str | None, k: int) -> Indices:
    """Return the positions of a drive term's base parameters at a joint (from 0)."""
    symbols = [s for term in base.drive.terms if term.key == key for s in term.symbols]
    names = {f"{symbol}{k + 1}" for symbol in symbols}
    return np.array([j for j, name in enumerate(base.names) if name in names], dtype=np.int64)


def locate_drive_parameters(base: BaseParameters, joint: int) -> dict[str, list[int]]:
    """Return where the drive parameters of a joint (from 0) are among the base parameters."""
    groups: dict[str, list[int]] = {}
    for term in base.drive.terms:
        groups.setdefault(find_group(term), []).extend(find_places(base, term.key, joint).tolist())
    return {group: places for group, places in groups.items() if places}
