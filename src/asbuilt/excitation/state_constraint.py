"""Constraints on the joint state at one instant."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from asbuilt.arrays import Array


class StateConstraint(ABC):
    """Bound a function of the joint state at one instant: torque, distance, place of the tool.

    Its values are normalised: they must stay below 1, and above -1 if `two_sided`.
    """

    name: str
    two_sided: bool

    @abstractmethod
    def values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the normalised values (N, m) at the states (N, n)."""

    @abstractmethod
    def slopes(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the derivatives of the values (N, m, n, r) by position and time derivatives.

        `r` orders are given: 1 for position alone, 3 up to acceleration.
        """

    def smallest_distance(self, q: Array) -> float | None:
        """Return the smallest distance between bodies over poses (N, n) [m], None if unchecked."""
        return None

    def notes(self, q: Array, qd: Array, qdd: Array) -> tuple[str, ...]:
        """Return sentences about how the states (N, n) keep the constraint."""
        return ()


def smallest_distance(constraints: Sequence[StateConstraint], q: Array) -> float | None:
    """Return the smallest distance between bodies that any of the constraints checks [m]."""
    found = (constraint.smallest_distance(q) for constraint in constraints)
    return min((distance for distance in found if distance is not None), default=None)
