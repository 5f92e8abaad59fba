"""The motion as a table that programs in C++ read: `t`, positions, velocities, at a fixed rate."""

from __future__ import annotations

import numpy as np

from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.motion_csv import times_to_end

DECIMALS = 12
"""Decimals of positions and velocities, so that differences at 1 kHz give a clean jerk."""


def motion_table(motion: Motion, rate: float) -> str:
    """Return CSV with the header `t,q1,...,qn,qd1,...,qdn`.

    The end of the motion is the last line whatever the rate.
    """
    t = times_to_end(motion, rate)
    q, qd, _ = motion.at(t)
    n = motion.n_joints
    header = ",".join(
        ["t", *(f"q{j}" for j in range(1, n + 1)), *(f"qd{j}" for j in range(1, n + 1))]
    )
    rows = np.hstack([np.round(q, DECIMALS), np.round(qd, DECIMALS)]) + 0.0
    lines = [
        f"{time:.6f}," + ",".join(f"{value:.{DECIMALS}f}" for value in row)
        for time, row in zip(t, rows, strict=True)
    ]
    return "\n".join([header, *lines]) + "\n"
