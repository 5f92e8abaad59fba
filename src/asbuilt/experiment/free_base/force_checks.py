"""Checks of measured forces: their axes and sign by the weight of the robot, and contact flags.

The forces on a robot are together what moves its centre of mass and carries its weight, whatever
its joints do. So the masses of a description say in which axes the forces are, and which way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.free_base.measured_forces import (
    collect_measured_wrenches,
    detect_force,
    turn_into_world_axes,
)
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure, Finding, join_names


@dataclass(frozen=True, slots=True)
class ForceLimits:
    """Say from when forces are read wrongly: own choices, tested on virtual robots.

    Forces are averaged over `window` [s]. Another reading must leave less than `share` of the
    squared disagreement with the weight. Flags and forces disagree in more than a part `often`.
    """

    window: float = 0.1
    share: float = 0.25
    often: float = 0.1


LIMITS = ForceLimits()


def check_forces(model: RobotModel, recording: Recording, rates: Array) -> Iterator[Finding]:
    """Find forces in other axes or of other sign, and flags that disagree with them."""
    wrenches = collect_measured_wrenches(recording, model)
    if not wrenches or model.n_floating != 6:
        return
    own = {place: f[:, :3] for place, f in wrenches.items()}
    world = _add_up(turn_into_world_axes(model, recording.q, place, f) for place, f in own.items())
    needed = inverse_dynamics(model, recording.q, rates, np.gradient(rates, recording.t, axis=0))[
        :, :3
    ]
    known = np.isfinite(world).all(axis=1)
    if recording.contact is not None:
        known &= ~(recording.contact > 0.5).any(axis=1)

    def off(force: Array) -> float:
        width = max(1, round(LIMITS.window * recording.rate))
        left = (needed - force)[known]
        means = left[: len(left) // width * width].reshape(-1, width, 3).mean(axis=1)
        return float(np.mean(means**2)) if len(means) else 0.0

    plain = _add_up(own.values())
    readings = {
        "in world axes": plain,
        "those of the robot on its surroundings": -world,
        "those of the robot on its surroundings, in world axes": -plain,
    }
    best = min(readings, key=lambda name: off(readings[name]))
    if off(readings[best]) < LIMITS.share * off(world):
        yield Finding(
            "force_axes",
            "error",
            f"measured forces at {join_names([place.frame for place in own])} are {best}: so"
            " read, they"
            " carry the weight of the robot; as forces on it in axes of these frames they do not",
            Cure("turn them into axes of the frames, with the sign of what acts on the robot"),
        )
    for place, force in own.items():
        flag = recording.extra.get(f"contact_{place.frame}")
        if flag is None:
            continue
        closed = detect_force(np.linalg.norm(force, axis=1))
        wrong = float(np.mean((flag > 0.5) != (closed > 0.5)))
        if wrong > LIMITS.often:
            yield Finding(
                "contact_force_flags",
                "warning",
                f"contact_{place.frame} and the force measured there disagree in {100 * wrong:.0f}"
                " % of the time; the force is used",
                Cure("check the flags, and the clock and zero of the force"),
            )


def _add_up(forces: Iterable[Array]) -> Array:
    return np.asarray(np.sum(list(forces), axis=0))
