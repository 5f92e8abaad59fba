"""Tables of the 2015 paper, with its expressions in the notation of asbuilt.

Hayat, Abhishek and Saha, "Dynamic Identification of Manipulator: Comparison between CAD and Actual
Parameters", iNaCoMM 2015-94.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from asbuilt.arrays import Array

_TERM = re.compile(r"([+-]?)\s*(?:([0-9.]+)\*)?(?:I(\d)([xyz]{2})|m(\d)\*d\5([xyz])|m(\d))(?=\s|$)")


@dataclass(frozen=True, slots=True)
class PublishedParameter:
    """Hold one row of Table 2.

    Parameters
    ----------
    id
        Id among the 70 standard parameters.
    expression
        Expression as corrected.
    cad, robot
        The two columns of values [SI].
    printed
        Expression as printed if that is a misprint.
    """

    id: int
    expression: str
    cad: float
    robot: float
    printed: str | None = None

    def coefficients(self, standard_names: Sequence[str]) -> Array:
        """Return the coefficients of the standard parameters, shape (n_standard,)."""
        row = np.zeros(len(standard_names))
        for sign, factor, *parts in _TERM.findall(self.expression):
            inertia_link, axes, moment_link, axis, mass_link = parts
            # A term has one of the three: I1yy, m1*d1x or m1, which are Iyy1, mx1 and m1 here.
            name = f"I{axes}{inertia_link}" if inertia_link else f"m{axis}{moment_link}{mass_link}"
            row[standard_names.index(name)] = float(f"{sign}{factor or 1.0}")
        unread = _TERM.sub("", self.expression).strip()
        if unread:
            raise ValueError(
                f"row {self.id} of Table 2: cannot read {unread!r} in {self.expression!r}"
            )
        return row


@dataclass(frozen=True, slots=True)
class Paper:
    """Hold what the paper prints: Tables 2 and 3, the number of samples, alpha_7 of Table 1 [deg].

    The paper highlights rows of Table 2 "having significantly larger values compared to the rest"
    in gray; its text does not list them. `highlighted` are the rows whose CAD value exceeds 1 [SI].
    """

    parameters: tuple[PublishedParameter, ...]
    table3_joints: tuple[int, ...]
    table3_cad: tuple[float, ...]
    table3_robot: tuple[float, ...]
    samples: int
    alpha_7_printed: float

    @property
    def cad(self) -> Array:
        """CAD column of Table 2, shape (43,)."""
        return np.array([row.cad for row in self.parameters])

    @property
    def robot(self) -> Array:
        """Robot column of Table 2, shape (43,)."""
        return np.array([row.robot for row in self.parameters])

    @property
    def highlighted(self) -> tuple[int, ...]:
        """Places of the gray rows of Table 2, counted from 0."""
        return tuple(np.flatnonzero(self.cad > 1.0).tolist())


def read_paper() -> Paper:
    """Return the paper's facts.

    >>> paper = read_paper()
    >>> len(paper.parameters), paper.parameters[0].expression
    (43, 'I1yy + I2zz')
    """
    facts = tomllib.loads(
        files("asbuilt.apps.paper").joinpath("facts.toml").read_text(encoding="utf-8")
    )
    return Paper(
        parameters=tuple(PublishedParameter(**row) for row in facts["table2"]),
        table3_joints=tuple(facts["table3"]["joints"]),
        table3_cad=tuple(facts["table3"]["cad"]),
        table3_robot=tuple(facts["table3"]["robot"]),
        samples=facts["paper"]["samples"],
        alpha_7_printed=facts["paper"]["alpha_7_printed_deg"],
    )
