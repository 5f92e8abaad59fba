"""Units of a robot's own size, in which tolerances of arms are those of any robot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from asbuilt.description.appearance import measure_distances
from asbuilt.description.model import RobotModel


class SizeUnits(NamedTuple):
    """Hold a unit of length [m] and one of mass [kg]."""

    length: float
    mass: float

    def torque(self, *, revolute: bool) -> float:
        """Return the unit of torque or force at a joint [N m or N]."""
        return self.mass * self.length ** (2 if revolute else 1)


def find_size_units(model: RobotModel) -> SizeUnits:
    """Return the millimetre, metre or kilometre, and the microgram, kilogram or megatonne.

    The nearest to the length of the longest chain and to the mass of all links, one and one for
    arms from 3 cm to 30 m and from 32 mg to 32 t: steps of mass are cubes of those of length, and
    all arms that are sold lie within one. Numbers of such arms are then the same whatever their
    size.
    """
    masses = [link.inertia.mass for link in model.links if link.inertia.mass > 0.0]
    return SizeUnits(
        find_prefix(float(np.max(measure_distances(model), initial=0.0)), 1e3),
        find_prefix(float(np.sum(masses)), 1e9),
    )


def find_prefix(size: float, step: float) -> float:
    """Return the power of a step that is nearest to a size by its logarithm; 1 of nothing."""
    return float(step ** round(np.log(size) / np.log(step))) if size > 0.0 else 1.0
