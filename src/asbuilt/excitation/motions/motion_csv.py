"""Motions from CSV files: `t, q_<joint>..., qd_<joint>..., qdd_<joint>...` in SI units.

`asbuilt.writers.recording_files` writes them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.joint_matching import match_joints
from asbuilt.description.model import RobotModel
from asbuilt.errors import MotionError, RecordingError
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.piecewise import SplineMotion
from asbuilt.excitation.motions.quintic import QuinticMotion
from asbuilt.findings import Cure
from asbuilt.ranges import Range
from asbuilt.untrusted import TABLE_LIMIT, describe_problem, name_file_in_errors, read_bytes

PREFIXES = ("q_", "qd_", "qdd_")
"""Column names are a prefix and a joint name."""
STEPS = Range(1e-6, 1e6, "s")
"""Times from line to line: the fastest controllers take a position every 10 us."""
VALUES = Range(-1e12, 1e12)
"""Positions, speeds, accelerations, and times since 1970, in any unit."""


class SampledMotion(QuinticMotion):
    """Move through samples of position, velocity and acceleration.

    Between two samples along the quintic that matches both.

    `joint_names` (n,) names the columns. At the sample times the motion has exactly the given
    values.
    """

    parametrisation = "sampled"
    joint_names: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        t: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        joint_names: Sequence[str] = (),
    ) -> SampledMotion:
        """Build from times (N,), shifted to start at 0, and samples (N, n)."""
        motion = cls.through(q, t, qd, qdd)
        motion.joint_names = tuple(joint_names) or tuple(
            f"joint_{j}" for j in range(1, motion.n_joints + 1)
        )
        return motion


def read_motion(path: str | os.PathLike[str], model: RobotModel | None = None) -> SampledMotion:
    """Read a motion from CSV; with a `model`, joints are put into its order by name or number.

    Velocities and accelerations may be missing; they then come from the natural quintic spline
    through the positions.

    Raises
    ------
    MotionError
        If the file is not a motion: unreadable, no `t` or `q_` columns, text or empty cells, times
        that do not rise, joints that the robot does not have.
    """
    source = Path(path)
    content = read_bytes(source, "motion", MotionError, TABLE_LIMIT)
    try:
        table = pl.read_csv(content, infer_schema_length=None)
    except (OSError, pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise MotionError(f"motion {source} cannot be read: {describe_problem(error)}") from None
    names = tuple(column.removeprefix("q_") for column in table.columns if column.startswith("q_"))
    if "t" not in table.columns or not names:
        raise MotionError(
            f"{source} is not a motion: it needs a column t and columns q_<joint>; it has"
            f" {', '.join(table.columns[:12])}"
        )
    if not table.height:
        raise MotionError(f"{source} is not a motion: it has a header but no data")
    labels = names
    if model is not None:
        labels = _match_labels(names, model, source)
        names = model.joint_names
    given = [
        prefix for prefix in PREFIXES if any(column.startswith(prefix) for column in table.columns)
    ]
    t = _read_numbers(table, ["t"], source)[:, 0]
    _check_steps(t, source)
    q, *rates = (
        _read_numbers(table, [prefix + label for label in labels], source) for prefix in given
    )
    if len(rates) < 2 and t.size < 6:
        raise MotionError(
            f"{source} has {t.size} positions without qd_ and qdd_ columns; give these or at"
            " least 6 positions"
        )
    with name_file_in_errors(source):
        if len(rates) < 2:
            spline = SplineMotion.through(q, t, ends="natural")
            rates = [spline.derivative(t - t[0], order) for order in (1, 2)]
        return SampledMotion.of(t, q, rates[0], rates[1], names)


def _check_steps(t: Array, source: Path) -> None:
    """Raise `MotionError` with line and value unless times (N,) rise by steps of a controller."""
    steps = np.diff(t)
    if t.size < 2 or not np.all(steps > 0):
        row = int(np.argmin(steps > 0)) + 3 if t.size > 1 else 2
        raise MotionError(
            f"{source}: times must rise from line to line and there must be two; they do not at"
            f" line {row}"
        )
    for k in (int(steps.argmin()), int(steps.argmax())):
        if not STEPS.holds(float(steps[k])):
            raise MotionError(
                f"{source}: line {k + 3} comes {steps[k]:g} s after the one before it; it must be"
                f" {STEPS}",
                cure=Cure("give the times in seconds"),
                value=float(steps[k]),
            )


def _match_labels(labels: Sequence[str], model: RobotModel, source: Path) -> tuple[str, ...]:
    """Return the label of each joint of the robot, matched as the columns of logs are."""
    try:
        order, _ = match_joints(labels, model.joint_names, source=str(source), robot=model.name)
    except RecordingError:
        order = []
    if len(order) == len(labels):
        return tuple(labels[k] for k in order)
    missing = [name for name in model.joint_names if name not in labels]
    unknown = [name for name in labels if name not in model.joint_names]
    raise MotionError(
        f"{source} does not fit {model.name}: missing joints {', '.join(missing) or 'none'},"
        f" unknown joints {', '.join(unknown) or 'none'}; the robot has"
        f" {', '.join(model.joint_names)}"
    )


def times_to_end(motion: Motion, rate: float) -> Array:
    """Return the times 0, 1/rate, .

    And the end of the motion, which is left out if it comes within a hundredth of a period or 1 us
    after these.
    """
    t = motion.sample_times(rate)
    # 0.01: the last step to the end of a motion is no shorter than this part of the sampling
    # period.
    return np.append(t, motion.duration) if motion.duration - t[-1] > max(0.01 / rate, 1e-6) else t


def _read_numbers(table: pl.DataFrame, columns: Sequence[str], source: Path) -> Array:
    for column in columns:
        if column not in table.columns:
            raise MotionError(f"{source} has no column {column}; it has {', '.join(table.columns)}")
        if not table[column].dtype.is_numeric():
            text = next((k for k, cell in enumerate(table[column]) if not _is_number(cell)), 0)
            raise MotionError(
                f"{source}: line {text + 2}, column {column} holds {table[column][text]!r}, not a"
                " number"
            )
    values = table.select(pl.col(column).cast(pl.Float64) for column in columns).to_numpy()
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        raise MotionError(
            f"{source}: line {bad[0, 0] + 2}, column {columns[bad[0, 1]]} is empty or not finite"
        )
    large = np.argwhere(np.abs(values) > VALUES.upper)
    if large.size:
        line, column = large[0]
        raise MotionError(
            f"{source}: line {line + 2}, column {columns[column]} is {values[line, column]:g}; it"
            f" must be a number {VALUES}",
            cure=Cure("give it in SI units"),
            value=float(values[line, column]),
        )
    return np.asarray(values, dtype=np.float64)


def _is_number(cell: object) -> bool:
    try:
        float(str(cell))
    except ValueError:
        return False
    return True
