"""Smooth curve of torque over the position of the far side of a drive."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

from asbuilt.dynamics.drives.term import DriveTerm, NonlinearValue, drive_term
from asbuilt.dynamics.drives.terms.elastic.cable import CURVE, HIGHEST, ORDER, of_curve


@drive_term
class MotorCable(DriveTerm):
    """Add `sum_k Cs_k (s / pi)^k` of the far side s to each coordinate that turns it.

    `s = T q`, as for the other terms of the far side; `cable` is the same on the near side.
    """

    order: NonlinearValue = None

    key = "motor_cable"
    position = 76
    symbols = tuple(f"C{k}s" for k in range(1, HIGHEST + 1))
    columns = CURVE
    formula = "T^T sum_k Cks (T q / pi)^k, k <= order"
    revolute_units = ("N m",) * HIGHEST
    prismatic_units = ("N",) * HIGHEST
    nonlinear = (ORDER,)
    of_motor = True
    by_construction = True

    def powers_of_ratio(self) -> tuple[float, ...]:
        """Return 1 + k for the power k of position."""
        return tuple(1.0 + k for k in range(1, HIGHEST + 1))

    def functions(self) -> tuple[Mapping[Hashable, float], ...]:
        """Return the powers, which nothing else has."""
        return of_curve(self.value("order"), own=self.key)
