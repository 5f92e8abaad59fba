"""Effects by which a robot changes: friction and gain of a joint, payload, tilt, its links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.effects.families.bodies import Payload
from asbuilt.identification.effects.families.log import Gain
from asbuilt.identification.effects.families.tilt import Tilt
from asbuilt.identification.effects.groups import LINKS, drive_places
from asbuilt.workflow.fleet.drift.columns import FleetColumns


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Describe an effect that can change.

    Parameters
    ----------
    effect, joint
        Its key, and the joint from 0; None for an effect of the whole robot.
    design
        The change of the columns by a unit of each of its m parameters, (size, m).
    """

    effect: str
    joint: int | None
    design: Array


def sources_of(columns: FleetColumns) -> tuple[Source, ...]:
    """Return the effects that can change in a robot type; without those that its columns lack."""
    n, base, unit = columns.n_joints, columns.base, np.eye(columns.size)
    found = [
        Source(effect, k, unit[:, places])
        for k in range(n)
        for effect, places in drive_places(base, k).items()
    ]
    found += [Source(Gain.key, k, unit[:, [columns.gains.start + k]]) for k in range(n)]
    K = unit[:, : base.n_base] @ base.regrouping[:, 10 * columns.tool_link :][:, :10]
    links = np.flatnonzero(base.columns < 10 * base.n_links)
    return (
        *found,
        Source(Payload.key, None, K),
        Source(Tilt.key, None, unit[:, -2:]),
        Source(LINKS, None, unit[:, links]),
    )


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
    """Return the changes of effects of usual size, (size, number of changes).

    `information` is that of a day about the parameters beta.
    """
    found = []
    payload = np.repeat(USUAL.payload, (6, 3, 1))
    for source in sources_of(columns):
        places = np.argmax(np.abs(source.design), axis=0)
        clear = np.sqrt(np.einsum("im,ij,jm->m", source.design, information, source.design))
        clear = np.where(clear > 0.0, clear, np.inf)
        present = np.abs(beta[np.minimum(places, len(beta) - 1)])
        sizes = {
            "friction": USUAL.friction * present,
            "armature": USUAL.armature * present,
            Gain.key: np.full(len(places), USUAL.gain),
            Tilt.key: np.full(len(places), USUAL.tilt),
            Payload.key: payload,
        }
        size = sizes.get(source.effect, USUAL.others / clear)
        found.append(source.design * np.minimum(size, USUAL.most / clear))
    return np.hstack(found)
