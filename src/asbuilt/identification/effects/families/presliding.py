"""Friction before sliding: bristles that bend until they slide."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.identification.effects.effect import Described, Effect, Motion, Variant, effect


def presliding_column(q: ArrayLike, stiffness_length: float) -> Array:
    """Return friction of bent bristles over Coulomb friction, in [-1, 1], shape (N,).

    The deflection z, over that at which bristles slide, follows `dz/dq = (1 - sign(qd) z) / s` with
    the stiffness length s = Coulomb friction over bristle stiffness: over a path x without
    reversal it is `sign - (sign - z0) exp(-|x| / s)`, whatever the speed. `Fc z` takes the place of
    `Fc sign(qd)`, to which it tends for s to 0. Bristles are straight at the start.

    A term of a drive has formulas of one instant; this column depends on the past. Positions need
    to be filtered: noise bends bristles to and fro, which straightens them.

    Source: Dahl, A solid friction model, Aerospace Corporation TOR-0158(3107-18)-1, 1968.

    Parameters
    ----------
    q
        Positions of one joint [rad or m] without a gap in time, shape (N,).
    stiffness_length
        Displacement s > 0 [rad or m] after which bristles that were straight carry 63 % of Coulomb
        friction.

    Examples
    --------
    >>> presliding_column([0.0, 0.01, 0.1, 0.1, 0.09], 0.01).round(3).tolist()
    [0.0, 0.632, 1.0, 1.0, -0.264]
    """
    x = np.asarray(q, dtype=np.float64)
    z = np.zeros(x.shape)
    side = np.sign(np.diff(x))
    # A zero product is a pause, which ends a stretch as a reversal does.
    turns = np.flatnonzero(side[1:] * side[:-1] <= 0.0) + 1
    # Within a stretch the path is monotonic, and the exponential has a closed form.
    for start, stop in pairwise([0, *turns.tolist(), x.size - 1]):
        way = np.abs(x[start + 1 : stop + 1] - x[start]) / stiffness_length
        # A single sample has no step and so no direction.
        sign = side[start] if start < stop else 0.0
        z[start + 1 : stop + 1] = sign - (sign - z[start]) * np.exp(-way)
    return z


LENGTHS = (0.001, 0.002, 0.004)
"""Trial displacements after which bristles slide, as shares of the range of positions."""


@effect
class Presliding(Effect):
    """Let the bristles of Coulomb friction bend before they slide (Dahl 1968).

    The column is what bent bristles carry less than `sign(qd)`; its value is Coulomb friction.
    """

    key = "presliding"
    title = "presliding friction"
    positive = True
    kind = "friction"
    units = ("N m", "N")
    by_span = True

    def variants(self, robot: Described) -> Iterator[Variant]:
        """Yield trial displacements at every joint with Coulomb friction."""
        coulomb = next((term for term in robot.drive.terms if term.key == "coulomb"), None)
        joints = tuple(k for k in range(robot.model.n_joints) if coulomb and coulomb.is_at(k))
        for share in LENGTHS if joints else ():
            yield Variant(self, 1, local=True, joints=joints, trial=share)

    def columns(self, variant: Variant, motion: Motion) -> list[Array]:
        """Return bent bristles less sliding ones."""
        # A joint that stands still has no range; its length stays above zero.
        length = variant.trial * np.maximum(np.ptp(motion.q, axis=0), 1e-6)
        bent = [presliding_column(q, s) for q, s in zip(motion.q.T, length, strict=True)]
        # Less the sliding friction of the model, whose parameter the two then share.
        return [np.stack(bent, axis=1) - np.sign(motion.qd)]
