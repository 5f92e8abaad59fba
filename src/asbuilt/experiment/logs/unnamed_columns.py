"""Guess of what the columns of a log hold, from their values and the robot's gravity torques."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import gravity_torque

CLEAR_LOAD = 0.5
"""Correlation with gravity's torque from which a group is taken for torques."""
NEAR_LOAD = 0.8
"""Share of the best correlation from which groups count alike, in the order of the file: what was
commanded correlates better than what was measured.
"""
LARGEST_ANGLE = 400.0
"""Positions beyond are none, neither in radians nor in degrees."""
MOST_SAMPLES = 2000
"""Samples that a guess looks at."""


DRAFT = '[columns]\ntime = 1\nposition = "2-7"\ntorque = "8-13"'
"""What a sheet looks like, where nothing of it can be guessed."""


def suggest_sheet(
    columns: Mapping[str, Array],
    model: RobotModel | None = None,
    *,
    named: bool = False,
    rate: float | None = None,
) -> str:
    """Return a recording sheet for columns of unknown meaning, as far as their values decide it.

    An increasing first column is time, a group that is another's derivative its velocity. With a
    robot, torque is the first group that correlates clearly with its gravity torques at the
    positions; without one, the first of the groups left over.

    Parameters
    ----------
    columns
        Values by name, in the order of the file, (N,) each.
    model
        The robot.
    named
        Whether the file has a header row.
    rate
        The sampling rate that was given [Hz].
    """
    values = list(columns.values())
    has_time = int(bool(values) and _increases(values[0]))
    head = [] if named else ["header = false"]
    n_rest = len(values) - has_time
    n_joints = (
        _joints_by_derivative(values[has_time:], values[0] if has_time else None)
        if model is None
        else model.n_joints
    )
    if rate is not None:
        head.append(f"rate = {rate:g}")
    if not n_joints or n_rest < 2 * n_joints:
        return "\n".join([*head, DRAFT])
    if not has_time and rate is None:
        head.append("rate = 100  # Hz")
    t = values[0] if has_time else np.arange(values[0].size, dtype=np.float64)
    groups = [
        np.column_stack(values[has_time + k * n_joints : has_time + (k + 1) * n_joints])
        for k in range(n_rest // n_joints)
    ]
    lines = [*head, "[columns]"]
    if has_time:
        lines.append("time = 1")
    position, velocity, torques = _roles(t, groups, model)
    span = {
        k: f'"{has_time + k * n_joints + 1}-{has_time + (k + 1) * n_joints}"'
        for k in range(len(groups))
    }
    lines.append(f"position = {span[position]}")
    if velocity is not None:
        lines.append(f"velocity = {span[velocity]}")
    if torques:
        also = f"  # or {', '.join(span[k] for k in torques[1:])}" if len(torques) > 1 else ""
        lines.append(f"torque = {span[torques[0]]}{also}")
    over = n_rest - n_joints * len(groups)
    if over:
        lines.append(f"# {over} more columns follow")
    return "\n".join(lines)


def _roles(
    t: Array, groups: list[Array], model: RobotModel | None
) -> tuple[int, int | None, list[int]]:
    """Return the groups of positions and velocities, and those of torques, the likeliest first."""
    position, velocity = _position_and_velocity(t, groups)
    loads = None if model is None else _load_matches(model, groups)
    if loads is not None and velocity is None:
        position = int(np.argmax(np.max(loads, axis=1)))
    rest = [k for k in range(len(groups)) if k not in (position, velocity)]
    if loads is not None and np.max(loads[position]) > CLEAR_LOAD:
        rest.sort(key=lambda k: loads[position, k] < NEAR_LOAD * np.max(loads[position]))
    return position, velocity, rest


def _load_matches(model: RobotModel, groups: list[Array]) -> Array:
    """Return how each group (column) follows gravity's torques at each group (row) as positions.

    The largest magnitude of the correlation over the joints that carry much of the load.
    """
    matches = np.zeros((len(groups), len(groups)))
    step = max(1, groups[0].shape[0] // MOST_SAMPLES)
    for i, q in enumerate(groups):
        rows = q[::step]
        if not np.all(np.isfinite(rows)) or np.abs(rows).max() > LARGEST_ANGLE:
            continue
        load = gravity_torque(model, rows)
        heavy = np.ptp(load, axis=0) > 0.1 * max(float(np.ptp(load, axis=0).max()), 1e-9)
        for k, tau in enumerate(groups):
            if k != i:
                matches[i, k] = _match(load[:, heavy], tau[::step][:, heavy])
    return matches


def _match(wanted: Array, found: Array) -> float:
    """Return the median magnitude of the correlations of columns."""
    sizes = []
    for a, b in zip(wanted.T, found.T, strict=True):
        ok = np.isfinite(a) & np.isfinite(b)
        if ok.sum() > 10 and np.std(a[ok]) > 0 and np.std(b[ok]) > 0:
            sizes.append(abs(float(np.corrcoef(a[ok], b[ok])[0, 1])))
    return float(np.median(sizes)) if sizes else 0.0


def _increases(values: Array) -> bool:
    finite = values[np.isfinite(values)]
    return finite.size > 1 and bool(np.all(np.diff(finite) >= 0)) and finite[-1] > finite[0]


def _position_and_velocity(t: Array, groups: list[Array]) -> tuple[int, int | None]:
    """Return the groups of which the second follows the derivative of the first, or the first."""
    best, pair = 0.8, None
    for i, q in enumerate(groups):
        for k, qd in enumerate(groups):
            if i != k and (match := _derivative_match(t, q, qd)) > best:
                best, pair = match, (i, k)
    return pair if pair is not None else (0, None)


def _derivative_match(t: Array, q: Array, qd: Array) -> float:
    """Return the median correlation of the columns of qd with the derivative of q."""
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.gradient(q, axis=0) / np.gradient(t)[:, None]
    matches = []
    for a, b in zip(slope.T, qd.T, strict=True):
        ok = np.isfinite(a) & np.isfinite(b)
        if ok.sum() > 10 and np.std(a[ok]) > 0 and np.std(b[ok]) > 0:
            matches.append(float(np.corrcoef(a[ok], b[ok])[0, 1]))
    return float(np.median(matches)) if matches else 0.0


def _joints_by_derivative(values: list[Array], t: Array | None) -> int | None:
    """Return the number of joints that makes the second group the derivative of the first."""
    clock = (
        t
        if t is not None
        else np.arange(values[0].size, dtype=np.float64)
        if values
        else np.zeros(0)
    )
    for n in range(2, len(values) // 2 + 1):
        if (
            len(values) % n == 0
            and _derivative_match(
                clock, np.column_stack(values[:n]), np.column_stack(values[n : 2 * n])
            )
            > 0.8
        ):
            return n
    return None
