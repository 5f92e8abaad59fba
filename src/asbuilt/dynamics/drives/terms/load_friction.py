"""Coulomb friction in proportion to the load that gears and bearings carry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.term import ALL_SOURCES, DriveTerm
from asbuilt.errors import UsageError


@dataclass(frozen=True, slots=True)
class LoadFriction(DriveTerm):
    """Add `Fl |load| sign(qd)`, load being the torque of the rigid bodies at the joint, as the
    current model has it.

    Source: Hamon, Gautier and Garrec, IROS 2010: dry friction that depends on load.
    """

    key = "load_friction"
    position = 60
    symbols = ("Fl",)
    revolute_units = ("1",)
    prismatic_units = ("1",)
    tried_for = ALL_SOURCES
    non_negative = True
    ratio_powers = (0.0,)
    formula = "Fl |load| sign(qd)"
    needs_load = True

    def evaluate(self, q: Array, qd: Array, qdd: Array, load: Array | None, out: Array) -> None:
        """Write `|load| sign(qd)`; raises UsageError without a load."""
        if load is None:
            raise UsageError(
                f"drive term {self.key!r} needs the rigid-body torque of the joint; pass load,"
                f" nonlinear parameter {q.shape}"
            )
        np.multiply(np.abs(load), np.sign(qd), out=out[0])
