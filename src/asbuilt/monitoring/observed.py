"""What an observer makes of a log."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from asbuilt.arrays import Array, Mask


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Hold what an observer makes of a log.

    `t` (N,), `share` (N,) the weight of each new sample, -1 where the observer starts anew; `q`,
    `qd`, the lagged acceleration `qdd`, the lagged size `step` of the steps of torque between
    samples, the lagged largest error `unknown_friction` of friction whose direction is unknown, and
    the `residual` (N, n) [N m or N]. `left_out` rows of the log were not valid.
    """

    t: Array
    share: Array
    q: Array
    qd: Array
    qdd: Array
    step: Array
    unknown_friction: Array
    residual: Array
    left_out: int = field(default=0, kw_only=True)

    def part(self, rows: slice) -> Observed:
        """Return adjacent samples."""
        return Observed(self.t[rows], self.share[rows], *(x[rows] for x in self._of_joints))

    def select(self, keep: Mask) -> Observed:
        """Return the samples where `keep` (N,) is true; lags start anew after a gap."""
        share = self.share.copy()
        share[1:][~keep[:-1]] = -1.0
        return Observed(
            self.t[keep],
            share[keep],
            *(np.ascontiguousarray(x[keep]) for x in self._of_joints),
        )

    @property
    def _of_joints(self) -> tuple[Array, ...]:
        return self.q, self.qd, self.qdd, self.step, self.unknown_friction, self.residual
