"""Joints whose torque the model does not explain, and when."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.findings import Cure, Finding

if TYPE_CHECKING:
    from asbuilt.validation.prediction import Validation

UNEXPLAINED = 0.5
"""RMS error over the standard deviation of a joint's torque beyond which it is not explained."""
MATTERS = 0.05
"""RMS error over the largest RMS torque of any joint below which a joint is not named."""
PARTS, LONGEST, MOST = 20, 10, 0.8
"""Parts of the time; how many in a row, at most, have this share of the squared error if it comes
and goes."""


def unexplained_findings(training: Sequence[Validation]) -> Iterator[Finding]:
    """Name joints whose torque the model explains by less than three quarters of its variance.

    A torque that is small beside that of other joints is left out: friction and noise may be most
    of it.
    """
    for each in training:
        error = np.sqrt(np.mean(each.error**2, axis=0))
        spread = np.std(each.measured, axis=0)
        largest = float(np.max(np.sqrt(np.mean(each.measured**2, axis=0))))
        for k in np.flatnonzero((error > UNEXPLAINED * spread) & (error > MATTERS * largest)):
            yield Finding(
                "torque_unexplained",
                "warning",
                f"The model does not explain the torque of {each.joint_names[k]} in {each.source}:"
                f" RMS error {error[k]:.3g} of {spread[k]:.3g} {each.units[k]}"
                f"{_when(each.t, each.error[:, k])}",
                Cure("check the column, the sensor and what touched the robot then"),
                joint=each.joint_names[k],
            )


def _when(t: Array, error: Array) -> str:
    """Return when the error is large, if most of it comes at one time."""
    part = np.minimum(np.arange(t.size) * PARTS // t.size, PARTS - 1)
    sums = np.concatenate([[0.0], np.cumsum(np.bincount(part, error**2, PARTS))])
    for width in range(1, LONGEST + 1):
        within = sums[width:] - sums[:-width]
        first = int(np.argmax(within))
        if within[first] >= MOST * sums[-1]:
            inside = (part >= first) & (part < first + width)
            return f", most of it from {t[inside][0]:.4g} to {t[inside][-1]:.4g} s"
    return ""
