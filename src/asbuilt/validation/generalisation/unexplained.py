"""Joints whose torque the model does not explain, and when."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.findings import Cure, Finding
from asbuilt.validation.comparison.comparison import recording_name

if TYPE_CHECKING:
    from asbuilt.validation.prediction import Validation

UNEXPLAINED = 0.5
"""RMS error over the standard deviation of a joint's torque beyond which it is not explained."""
MATTERS = 0.05
"""RMS error over the largest RMS torque of any joint below which a joint is not named."""
PARTS, LONGEST, MOST = 20, 10, 0.8
"""Parts of the time; how many in a row, at most, have this share of the squared error if it comes
and goes."""
ONE_SIDED = 0.5
"""Mean error over its RMS from which that span is pushed: contacts of 4 s in virtual logs of two
arms have 0.55 and 0.75, errors in nine real recordings at most 0.34."""
PUSHED = 0.1
"""RMS error in that span over the standard deviation of a joint's torque that is a push."""


def unexplained_findings(training: Sequence[Validation]) -> Iterator[Finding]:
    """Name joints whose torque the model explains by less than three quarters of its variance.

    Also those whose error is mostly one push, a torque of one sign in one span of time. A torque
    that is small beside that of other joints is left out: friction and noise may be most of it.
    """
    for each in training:
        error = np.sqrt(np.mean(each.error**2, axis=0))
        spread = np.std(each.measured, axis=0)
        largest = float(np.max(np.sqrt(np.mean(each.measured**2, axis=0))))
        for k in np.flatnonzero(error > MATTERS * largest):
            wrong = each.error[:, k]
            within = large_stretch(each.t, wrong)
            pushed = within is not None and _is_push(wrong[within], spread[k])
            if not pushed and error[k] <= UNEXPLAINED * spread[k]:
                continue
            yield Finding(
                "torque_unexplained",
                "warning",
                f"The model does not explain the torque of {each.joint_names[k]} in"
                f" {recording_name(each.source)}:"
                f" RMS error {error[k]:.3g} of {spread[k]:.3g} {each.units[k]}"
                f"{when_large(each.t, wrong)}",
                Cure("check the column, the sensor and what touched the robot then"),
                joint=each.joint_names[k],
            )


def when_large(t: Array, error: Array) -> str:
    """Return when the error (N,) is large, as text; empty if not most of it comes at one time."""
    within = large_stretch(t, error)
    if within is None:
        return ""
    return f", most of it from {t[within][0]:.4g} to {t[within][-1]:.4g} s"


def large_stretch(t: Array, error: Array) -> Mask | None:
    """Return the samples (N,) of the shortest span with most of the squared error (N,).

    None if that is more than half the time.
    """
    part = np.minimum(np.arange(t.size) * PARTS // t.size, PARTS - 1)
    sums = np.concatenate([[0.0], np.cumsum(np.bincount(part, error**2, PARTS))])
    for width in range(1, LONGEST + 1):
        within = sums[width:] - sums[:-width]
        first = int(np.argmax(within))
        if within[first] >= MOST * sums[-1]:
            inside: Mask = (part >= first) & (part < first + width)
            return inside
    return None


def _is_push(error: Array, spread: float) -> bool:
    """Return whether errors (N,) of a span are large and of one sign."""
    size = float(np.sqrt(np.mean(error**2)))
    return size > PUSHED * spread and abs(float(np.mean(error))) > ONE_SIDED * size
