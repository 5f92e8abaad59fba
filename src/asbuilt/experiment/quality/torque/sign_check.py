"""Torques or currents that are logged without a sign."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.quality.running_statistics import Extremes
from asbuilt.findings import Cure, Finding

FEWEST_JOINTS = 2
"""Joints from which it is no accident that none has a torque of the other sign."""


def unsigned_findings(measured: Extremes) -> Iterator[Finding]:
    """Find torques that are never negative at any joint, as of coarse supply currents."""
    if is_unsigned(measured.low, measured.high):
        yield Finding(
            "torque_unsigned",
            "warning",
            "no joint has a negative torque: the log seems to hold magnitudes, such as a supply"
            " current, whose sign is unknown",
            Cure(
                "use the commanded positions if the log has them, with torque_source = command",
                settings={"torque_source": "command"},
            ),
        )


def is_unsigned(low: Array, high: Array) -> bool:
    """Return whether the extremes (n,) of the joints are those of magnitudes."""
    used = np.asarray(high) > 0.0
    return bool(np.count_nonzero(used) >= FEWEST_JOINTS and np.all(np.asarray(low) >= 0.0))
