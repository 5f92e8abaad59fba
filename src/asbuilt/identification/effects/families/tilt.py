"""Tilt of the base against the description."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import find_axes_across
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect


@effect
class Tilt(Effect):
    """Turn the base by small angles about two axes across gravity [rad].

    A base turned by a vector `theta` sees gravity turned by `-theta`: `g - theta x g` to first
    order, so that the columns are the gravity torques of the links under `g x axis`.
    """

    key = "tilt"
    title = "base tilt"
    units = ("deg", "deg")
    in_model = True
    least = float(np.deg2rad(0.25))
    """Accuracy of a floor that is called level."""
    usual = float(np.deg2rad(0.5))
    """Tables and floors that nobody levelled: of arms in published logs it is 1 to 2 degrees."""
    removable = True
    farthest = 0.35
    """[rad] Walls and ceilings belong into the description."""

    def size(self, values: Array, covariance: Array, *, revolute: bool) -> tuple[float, float, str]:
        """Return the angle between both directions of gravity [deg]."""
        size, error, unit = super().size(values, covariance, revolute=revolute)
        return float(np.rad2deg(size)), float(np.rad2deg(error)), unit

    def size_text(self, values: Array, covariance: Array, *, revolute: bool) -> str:
        """Return the angle with its parts about both axes."""
        whole = super().size_text(values, covariance, revolute=revolute)
        parts = np.rad2deg(values)
        return f"{whole} ({parts[0]:+.2f} about x, {parts[1]:+.2f} about y)"

    def without(
        self, model: RobotModel, samples: Sequence[Samples], joint: int | None, values: Array
    ) -> tuple[RobotModel, list[Samples]]:
        """Return the robot with its base turned by a tilt about the axes across gravity."""
        gravity = np.array(model.gravity)
        # Gravity in the base turns against the base.
        turn = -values @ find_axes_across(gravity)
        angle = float(np.linalg.norm(turn))
        # Rodrigues' formula of an axis across the vector; sinc(x) is sin(pi x) / (pi x).
        back = np.cos(angle) * gravity + np.sinc(angle / np.pi) * np.cross(turn, gravity)
        return model.tilted(back), list(samples)

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield the tilt of a robot with gravity."""
        if np.any(robot.model.gravity):
            yield Variant(self, 2, local=False)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return the gravity torques under `g x axis`."""
        model = motion.robot.model
        still = np.zeros_like(motion.q)
        links = motion.robot.chi[: 10 * model.n_links]
        # Torques at rest are linear in gravity: `g x axis` in its place gives the derivative
        # itself.
        return [
            inverse_dynamics(
                model.with_gravity(np.cross(model.gravity, axis)),
                motion.q,
                still,
                still,
                parameters=links,
            )
            for axis in find_axes_across(model.gravity)
        ]
