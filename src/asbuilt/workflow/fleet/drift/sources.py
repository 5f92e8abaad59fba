"""Sources of a change: friction and gain of a joint, payload, base tilt, mass distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.base.base_parameters import BaseParameters
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
    found: list[Source] = []
    for k in range(n):
        found += [
            Source(cause, k, _units(columns.size, places))
            for cause, places in drive_places(base, k).items()
            if places
        ]
    found += [Source("gain", k, _units(columns.size, [columns.gains.start + k])) for k in range(n)]
    K = np.zeros((columns.size, 10))
    K[: base.n_base] = base.regrouping[:, 10 * columns.tool_link :][:, :10]
    found += [Source("payload", None, K[:, 6:] * PAYLOAD_SIZE[6:])]
    found += [Source("payload", None, K * PAYLOAD_SIZE)]
    found.append(
        Source("mounting", None, _units(columns.size, [columns.size - 2, columns.size - 1]))
    )
    links = [i for i, column in enumerate(base.columns) if column < 10 * base.n_links]
    found.append(Source("links", None, _units(columns.size, links)))
    return tuple(found)


def drive_places(base: BaseParameters, joint: int) -> dict[str, list[int]]:
    """Return where friction, offset and armature of a joint are among the base parameters."""
    names = {name: i for i, name in enumerate(base.names)}
    groups: dict[str, list[int]] = {}
    for term in base.drive.terms:
        cause = term.cause or "friction"
        group = cause if cause in ("offset", "armature") else "friction"
        groups.setdefault(group, []).extend(
            names[f"{symbol}{joint + 1}"]
            for symbol in term.symbols
            if f"{symbol}{joint + 1}" in names
        )
    return groups


@dataclass(frozen=True, slots=True)
class UsualChanges:
    """Sizes of changes that robots usually undergo; they choose directions, and bias nothing.

    Shares of friction and armature, a gain, a tilt [rad], and inertia [kg m^2], first moments
    [kg m] and mass [kg] of a payload. Offsets and mass distributions are changed by `others`, and
    all at most by `most`, in standard errors of a day of the change alone.
    """

    friction: float = 0.3
    armature: float = 0.1
    gain: float = 0.05
    tilt: float = 0.005
    payload: tuple[float, float, float] = (0.005, 0.05, 0.5)
    others: float = 3.0
    most: float = 12.0


USUAL = UsualChanges()


def usual_changes(columns: FleetColumns, information: Array, beta: Array) -> Array:
    """Return the changes of sources of usual size, (size, number of changes).

    `information` is that of a day about the parameters beta.
    """
    found = []
    inertia, moment, mass = USUAL.payload
    payload = np.array([inertia] * 6 + [moment] * 3 + [mass]) / PAYLOAD_SIZE
    for source in sources_of(columns):
        places = np.argmax(np.abs(source.design), axis=0)
        clear = np.sqrt(np.einsum("im,ij,jm->m", source.design, information, source.design))
        clear = np.where(clear > 0.0, clear, np.inf)
        sizes = {
            "friction": USUAL.friction * np.abs(beta[np.minimum(places, len(beta) - 1)]),
            "armature": USUAL.armature * np.abs(beta[np.minimum(places, len(beta) - 1)]),
            "gain": np.full(len(places), USUAL.gain),
            "mounting": np.full(len(places), USUAL.tilt),
            "payload": payload[-len(places) :],
        }
        size = sizes.get(source.cause, USUAL.others / clear)
        found.append(source.design * np.minimum(size, USUAL.most / clear))
    return np.hstack(found)


def _units(size: int, places: list[int]) -> Array:
    design = np.zeros((size, len(places)))
    design[places, np.arange(len(places))] = 1.0
    return design
