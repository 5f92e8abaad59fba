"""Base parameters in plain words: what of which link, with what it carries, or what of which drive."""

from __future__ import annotations

import numpy as np

from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.dynamics.base_parameters import BaseParameters

DRIVE_WORDS = {"armature": "armature", "viscous": "viscous friction", "coulomb": "Coulomb friction", "offset": "torque offset"}
"""Drive terms whose key is not their name; the others are called by their key."""


def in_words(base: BaseParameters) -> tuple[str, ...]:
    """Return what each base parameter is, in words: `first moment along z, links 4 to 7`.

    A base parameter is called after the kept column and the last link that enters it.

    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.dynamics.base_parameters import find_base_parameters
    >>> from asbuilt.dynamics.drives.selection import DriveSet
    >>> base = find_base_parameters(bundled_robot("kuka-iiwa7-r800"), DriveSet.parse("coulomb"))
    >>> dict(zip(base.names, in_words(base)))["mz4"]
    'first moment along z, links 4 to 7'
    >>> in_words(base)[-1]
    'Coulomb friction, joint 7'
    """
    inertial = len(PARAMETER_NAMES) * (base.n_standard // (len(PARAMETER_NAMES) + base.drive.columns_per_joint))
    return tuple(
        _of_link(base, row, int(column), inertial) if column < inertial else _of_drive(base, int(column) - inertial)
        for row, column in enumerate(base.columns)
    )


def _of_link(base: BaseParameters, row: int, column: int, inertial: int) -> str:
    per_link = len(PARAMETER_NAMES)
    link, name = column // per_link, PARAMETER_NAMES[column % per_link]
    entries = np.flatnonzero(base.regrouping[row])
    own = {PARAMETER_NAMES[j % per_link] for j in entries if j // per_link == link and j < inertial}
    last = max(int(j) // per_link for j in entries if j < inertial)
    said = "mass" if name == "m" else f"first moment along {name[1]}" if name[0] == "m" else _moment(name, own)
    where = f"link {link + 1}" if last == link else f"links {link + 1} to {last + 1}"
    return f"{said}, {where}{' with rotors' if entries[-1] >= inertial else ''}"


def _moment(name: str, own: set[str]) -> str:
    if name[1] != name[2]:
        return f"product of inertia {name[1:]}"
    less = sorted(other for other in own if other != name and other[0] == "I" and other[1] == other[2])
    return f"inertia about {name[1]}" + "".join(f" less {other[1]}" for other in less)


def _of_drive(base: BaseParameters, place: int) -> str:
    joint, column = divmod(place, base.drive.columns_per_joint)
    term = [term for term in base.drive.terms for _ in term.letters][column]
    letter = f" {base.drive.letters[column]}" if len(term.letters) > 1 else ""
    return f"{DRIVE_WORDS.get(term.key, term.key.replace('_', ' '))}{letter}, joint {joint + 1}"
