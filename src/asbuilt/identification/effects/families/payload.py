"""A body at the flange that the description lacks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect


@effect
class Payload(Effect):
    """Carry a body at the flange: ten inertial parameters in the frame of the tool link.

    Bodies are free in a search, so that it has no columns there; `explain_bodies` finds it in what
    the bodies have beyond CAD.
    """

    key, title, in_model = "payload", "payload", True

    def unit(self, revolute: bool) -> str:
        """Return the unit of its mass."""
        return "kg"

    def size(self, values: Array, covariance: Array, *, revolute: bool) -> tuple[float, float, str]:
        """Return its mass."""
        return float(values[9]), float(np.sqrt(covariance[9, 9])), self.unit(revolute)

    def size_text(self, values: Array, covariance: Array, *, revolute: bool) -> str:
        """Return its mass and its centre of mass."""
        place = ", ".join(f"{1e3 * c:.0f}" for c in values[6:9] / values[9])
        mass = super().size_text(values, covariance, revolute=revolute)
        return f"{mass} with its centre of mass at ({place}) mm"

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield nothing."""
        yield from ()

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return no columns."""
        return []
