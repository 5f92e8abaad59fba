"""Bodies that the description lacks: at the flange, or as another mass of a link."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.effects.effect import (
    Described,
    Effect,
    FoundEffect,
    Motion,
    Variant,
    effect,
)


class _Body(Effect):
    """Hold a body: ten inertial parameters in the frame of a link.

    Bodies are free in a search, so that it has no columns there; `explain_bodies` finds it in what
    the bodies have beyond CAD.
    """

    in_model = True
    in_bodies = True
    units = ("kg", "kg")

    def size(self, values: Array, covariance: Array, *, revolute: bool) -> tuple[float, float, str]:
        """Return its mass."""
        # Order of the ten: six inertias, three first moments, the mass.
        return float(values[9]), float(np.sqrt(covariance[9, 9])), self.unit(revolute)

    # Bodies are columns of the model itself, so a variant would be counted twice.
    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield nothing."""
        yield from ()

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return no columns."""
        return []


@effect
class Payload(_Body):
    """Carry a body at the flange, in the frame of the tool link."""

    key = "payload"
    title = "payload"

    def size_text(self, values: Array, covariance: Array, *, revolute: bool) -> str:
        """Return its mass and its centre of mass."""
        # First moments over the mass are the centre of mass.
        place = ", ".join(f"{1e3 * c:.0f}" for c in values[6:9] / values[9])
        mass = super().size_text(values, covariance, revolute=revolute)
        return f"{mass} with its centre of mass at ({place}) mm"


@effect
class LinkMass(_Body):
    """Make the link behind a joint heavier or lighter, its centre staying."""

    key = "link_mass"
    title = "mass of a link"

    def size_text(self, values: Array, covariance: Array, *, revolute: bool) -> str:
        """Return its mass beyond CAD's."""
        return f"{super().size_text(values, covariance, revolute=revolute)} beyond CAD"

    def finding(self, found: FoundEffect, model: RobotModel) -> Finding:
        """Return that the link cannot have its CAD mass, whatever the others have."""
        others = f" (or {join_names(found.alternatives)})" if found.alternatives else ""
        return Finding(
            "link_mass_differs",
            "warning",
            f"No physically consistent robot with these torques has the CAD mass of a link:"
            f" {found.text}{others}",
            Cure("check the link, and what is mounted on it"),
            joint=found.joint,
        )
