"""Columns in addition to the base parameters', of which only inner products are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import find_axes_across
from asbuilt.dynamics.newton_euler import gravity_torque


@dataclass(slots=True, eq=False)
class ColumnsBeside:
    """Gather `[W_k | tau_k | T_k]^T T_k` of further columns T of every joint k, in order of time.

    T are the torques of the links by design under gravity `g x axis` for the two axes across
    gravity: the torque of a base tilted by an angle [rad] about an axis, to first order. With the
    factors of `[W_k | tau_k]` a change of the tilt can be estimated like one of any parameter.

    Parameters
    ----------
    models
        The robot under each tilted gravity.
    products
        The inner products of each joint, (p_k + 1 + m, m), m = 2; empty before the first block.
    """

    models: tuple[RobotModel, ...]
    products: list[Array] = field(default_factory=list)

    @classmethod
    def tilts(cls, model: RobotModel) -> ColumnsBeside:
        """Return the columns of two base tilts."""
        axes = find_axes_across(model.gravity)
        return cls(tuple(model.with_gravity(np.cross(model.gravity, axis)) for axis in axes))

    @property
    def count(self) -> int:
        """Number of columns m."""
        return len(self.models)

    def columns(self, q: Array) -> Sequence[Array]:
        """Return the columns of positions (L, n), each (L, n), before filtering."""
        return [gravity_torque(model, q) for model in self.models]

    def add(self, products: Sequence[Array]) -> None:
        """Add the inner products of the next time block."""
        if not self.products:
            self.products = [np.zeros_like(each) for each in products]
        self.products = [a + b for a, b in zip(self.products, products, strict=True)]
