"""Friction before sliding."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.drives.presliding import presliding_column
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect

LENGTHS = (0.001, 0.004)
"""Trial displacements after which bristles slide, as shares of the range of positions."""


@effect
class Presliding(Effect):
    """Let the bristles of Coulomb friction bend before they slide (Dahl 1968).

    The column is what bent bristles carry less than `sign(qd)`; its value is Coulomb friction.
    """

    key, title, positive, kind = "presliding", "presliding friction", True, "friction"
    by_span = True

    def unit(self, revolute: bool) -> str:
        """Return the unit of friction."""
        return "N m" if revolute else "N"

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield trial displacements at every joint with Coulomb friction."""
        own = next((each for each in robot.drive.terms if each.key == "coulomb"), None)
        joints = tuple(k for k in range(robot.model.n_joints) if own and own.is_at(k))
        for share in LENGTHS if joints else ():
            yield Variant(self, 1, local=True, joints=joints, trial=share)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return bent bristles less sliding ones."""
        t = np.arange(len(motion.q)) / motion.rate
        length = variant.trial * np.maximum(np.ptp(motion.q, axis=0), 1e-6)
        bent = [presliding_column(t, q, s) for q, s in zip(motion.q.T, length, strict=True)]
        return [np.stack(bent, axis=1) - np.sign(motion.qd)]
