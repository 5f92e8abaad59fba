"""Text for base parameters and drive terms, such as "first moment along z, links 4 to 7"."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.dynamics import BaseParameters, DriveSet, DriveTerm


def describe_parameters(base: BaseParameters) -> tuple[str, ...]:
    """Return what each base parameter is, named by the kept column and the last link that enters.

    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.dynamics.base.base_parameters import find_base_parameters
    >>> from asbuilt.dynamics.drives.drive_set import DriveSet
    >>> base = find_base_parameters(bundled_robot("kuka-iiwa7-r800"), DriveSet.parse("coulomb"))
    >>> dict(zip(base.names, describe_parameters(base)))["mz4"]
    'first moment along z, links 4 to 7'
    >>> describe_parameters(base)[-1]
    'Coulomb friction, joint 7'
    """
    inertial = len(PARAMETER_NAMES) * base.n_links
    return tuple(
        (
            _describe_link_parameter(base, row, int(column), inertial)
            if column < inertial
            else _describe_drive_parameter(base, int(column) - inertial)
        )
        for row, column in enumerate(base.columns)
    )


def describe_drive(drive: DriveSet) -> str:
    """Return the terms of a set with the joints that have them and their nonlinear parameters.

    >>> describe_drive(DriveSet.parse("viscous:joints=2/3,offset,stribeck:velocity=0.1"))
    'viscous friction (joints 2, 3); Stribeck friction (velocity 0.1); torque offset'
    >>> describe_drive(DriveSet.parse("power:joints=1/3:exponent=0.7/0.5/0.6"))
    'power-law friction (joint 1: exponent 0.7; joint 3: exponent 0.6)'
    """
    return "; ".join(_describe_term(term) for term in drive.terms) or "none"


def _describe_term(term: DriveTerm) -> str:
    stated = {
        parameter.name: getattr(term, parameter.name)
        for parameter in term.nonlinear
        if getattr(term, parameter.name) is not None
    }
    several = [len(values) for values in stated.values() if isinstance(values, tuple)]
    if several:
        inside = "; ".join(
            f"joint {number}: {_list_nonlinear(term.at(number - 1), stated)}"
            # Joints that have the term, or all of them.
            for number in term.joints or range(1, several[0] + 1)
        )
    else:
        where = (
            []
            if term.joints is None
            else [f"joint{'s' if len(term.joints) > 1 else ''} {', '.join(map(str, term.joints))}"]
        )
        inside = "; ".join([*where, *([_list_nonlinear(term, stated)] if stated else [])])
    return term.title + (f" ({inside})" if inside else "")


def _list_nonlinear(term: DriveTerm, names: Iterable[str]) -> str:
    return ", ".join(f"{name} {term.value(name):.3g}" for name in names)


def _describe_link_parameter(base: BaseParameters, row: int, column: int, inertial: int) -> str:
    per_link = len(PARAMETER_NAMES)
    link = column // per_link
    name = PARAMETER_NAMES[column % per_link]
    entries = np.flatnonzero(base.regrouping[row])
    names_here = {
        PARAMETER_NAMES[j % per_link] for j in entries if j // per_link == link and j < inertial
    }
    # The last link that enters: a base parameter is of all up to it.
    last = max(int(j) // per_link for j in entries if j < inertial)
    kind = (
        "mass"
        if name == "m"
        else f"first moment along {name[1]}"
        if name[0] == "m"
        else _name_moment(name, names_here)
    )
    where = f"link {link + 1}" if last == link else f"links {link + 1} to {last + 1}"
    return f"{kind}, {where}{' with rotors' if entries[-1] >= inertial else ''}"


def _name_moment(name: str, own: set[str]) -> str:
    if name[1] != name[2]:
        return f"product of inertia {name[1:]}"
    less = sorted(
        # Regrouping leaves differences of two moments, such as Ixx - Iyy.
        other
        for other in own
        if other != name and other[0] == "I" and other[1] == other[2]
    )
    return f"inertia about {name[1]}" + "".join(f" less {other[1]}" for other in less)


def _describe_drive_parameter(base: BaseParameters, place: int) -> str:
    joint, column = divmod(place, base.drive.columns_per_joint)
    term = [term for term in base.drive.terms for _ in term.symbols][column]
    symbol = f" {base.drive.symbols[column]}" if len(term.symbols) > 1 else ""
    return f"{term.title}{symbol}, joint {joint + 1}"
