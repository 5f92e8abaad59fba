"""The facts of the 2015 paper that asbuilt grew from, and its expressions in asbuilt's notation.

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
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TERM = re.compile(r"([+-]?)\s*(?:([0-9.]+)\*)?(?:I(\d)([xyz]{2})|m(\d)\*d\5([xyz])|m(\d))(?=\s|$)")


@dataclass(frozen=True, slots=True)
class PublishedParameter:
    """One row of Table 2: id of 70, expression (corrected; `printed` where the paper has a
    misprint), CAD and robot value.
    """

    id: int
    expression: str
    cad: float
    robot: float
    printed: str | None = None

    def coefficients(self, standard_names: Sequence[str]) -> Array:
        """Return the expression as a row of coefficients of the standard parameters, shape
        (n_standard,).
        """
        row = np.zeros(len(standard_names))
        for sign, factor, inertia_link, axes, moment_link, axis, mass_link in _TERM.findall(
            self.expression
        ):
            name = (
                f"I{axes}{inertia_link}"
                if inertia_link
                else f"m{axis}{moment_link}"
                if moment_link
                else f"m{mass_link}"
            )
            row[standard_names.index(name)] = (-1.0 if sign == "-" else 1.0) * float(factor or 1.0)
        unread = _TERM.sub("", self.expression).strip()
        if unread:
            raise ValueError(
                f"row {self.id} of Table 2: cannot read {unread!r} in {self.expression!r}"
            )
        return row


@dataclass(frozen=True, slots=True)
class Paper:
    """What the paper prints: Table 2, Table 3, the number of samples and alpha_7 of Table 1 [deg]."""

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


def published() -> Paper:
    """Return the paper's facts.

    >>> paper = published()
    >>> len(paper.parameters), paper.parameters[0].expression
    (43, 'I1yy + I2zz')
    """
    facts = tomllib.loads(
        files("asbuilt.cli").joinpath("hayat2015.toml").read_text(encoding="utf-8")
    )
    return Paper(
        parameters=tuple(PublishedParameter(**row) for row in facts["table2"]),
        table3_joints=tuple(facts["table3"]["joints"]),
        table3_cad=tuple(facts["table3"]["cad"]),
        table3_robot=tuple(facts["table3"]["robot"]),
        samples=facts["paper"]["samples"],
        alpha_7_printed=facts["paper"]["alpha_7_printed_deg"],
    )
