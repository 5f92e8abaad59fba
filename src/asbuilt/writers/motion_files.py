"""Motions as CSV files that `read_motion` and controllers read."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import Motion, Trajectory
from asbuilt.excitation.motions.motion_csv import PREFIXES, times_to_end
from asbuilt.writers.files import atomic_write


def write_motion(
    path: str | os.PathLike[str],
    motion: Motion | Trajectory,
    joint_names: Sequence[str],
    rate: float = 1000.0,
) -> Path:
    """Write a motion, sampled at `rate` [Hz], or a trajectory as CSV.

    Numbers have the digits that read back to the same double.

    The end of a motion is its last line whatever the rate, so that a motion that ends at rest does
    so in the file. Raises MotionError if names and joints do not go together, UsageError if the
    place is not writable.
    """
    trajectory = motion if isinstance(motion, Trajectory) else _sampled_to_end(motion, rate)
    names = tuple(joint_names)
    if len(names) != trajectory.n_joints or len(set(names)) != len(names):
        raise MotionError(
            f"a motion of {trajectory.n_joints} joints needs as many different names, got"
            f" {', '.join(names) or 'none'}"
        )
    columns = {"t": trajectory.t}
    for prefix, values in zip(PREFIXES, (trajectory.q, trajectory.qd, trajectory.qdd), strict=True):
        columns |= {prefix + name: values[:, j] for j, name in enumerate(names)}
    content = io.BytesIO()
    pl.DataFrame(columns).write_csv(content)
    return atomic_write(path, content.getvalue())


def _sampled_to_end(motion: Motion, rate: float) -> Trajectory:
    t = times_to_end(motion, rate)
    return Trajectory(t, *motion.at(t))
