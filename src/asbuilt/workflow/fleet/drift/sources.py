"""Sources of a change: friction and gain of a joint, payload, base tilt, mass distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.validation.attribution.causes import CAUSES
from asbuilt.workflow.fleet.drift.columns import FleetColumns

PAYLOAD_SIZE = np.array([1.0] * 6 + [1.0] * 3 + [10.0])
"""Scale of the inertial parameters of a payload: kg m^2, kg m, kg."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Describe a source of change.

    Parameters
    ----------
    cause
        Key of `CAUSES`.
    joint
        The joint, from 0; None for a source of the whole robot.
    design
        The change of the columns by a unit of each of its m parameters, (size, m).
    """

    cause: str
    joint: int | None
    design: Array

    @property
    def title(self) -> str:
        """The cause as text."""
        return CAUSES[self.cause]


def sources_of(columns: FleetColumns) -> tuple[Source, ...]:
    """Return the sources of change of a robot type; without those that its columns lack."""
    n, base = columns.n_joints, columns.base
    names = {name: i for i, name in enumerate(base.names)}
    found: list[Source] = []
    for k in range(n):
        groups: dict[str, list[int]] = {}
        for term in base.drive.terms:
            cause = term.cause or "friction"
            group = cause if cause in ("offset", "armature") else "friction"
            groups.setdefault(group, []).extend(
                names[f"{symbol}{k + 1}"] for symbol in term.symbols if f"{symbol}{k + 1}" in names
            )
        found += [
            Source(cause, k, _units(columns.size, places))
            for cause, places in groups.items()
            if places
        ]
    found += [
        Source("gain", k, _units(columns.size, [columns.gains.start + k])) for k in range(n)
    ]
    K = np.zeros((columns.size, 10))
    K[: base.n_base] = base.regrouping[:, 10 * (n - 1) : 10 * n]
    found += [Source("payload", None, K[:, 6:] * PAYLOAD_SIZE[6:])]
    found += [Source("payload", None, K * PAYLOAD_SIZE)]
    found.append(Source("mounting", None, _units(columns.size, [columns.size - 2, columns.size - 1])))
    links = [i for i, column in enumerate(base.columns) if column < 10 * n]
    found.append(Source("links", None, _units(columns.size, links)))
    return tuple(found)


def _units(size: int, places: list[int]) -> Array:
    design = np.zeros((size, len(places)))
    design[places, np.arange(len(places))] = 1.0
    return design
