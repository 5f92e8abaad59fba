"""Guess of what the columns of a log without a header row hold, from their values."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array


def suggest_sheet(columns: Mapping[str, Array], n_joints: int | None) -> str:
    """Return a recording sheet for columns without names, as far as their values decide it.

    An increasing column is time, a group that is another's derivative its velocity; the first of
    the other groups is torque.
    """
    values = list(columns.values())
    has_time = int(bool(values) and _increases(values[0]))
    n_rest = len(values) - has_time
    if n_joints is None:
        n_joints = _joints_by_derivative(values[has_time:], values[0] if has_time else None)
    if n_joints is None or n_joints == 0 or n_rest < 2 * n_joints:
        return 'header = false\n[columns]\ntime = 1\nposition = "2-7"\ntorque = "8-13"'
    t = values[0] if has_time else np.arange(values[0].size, dtype=np.float64)
    groups = [
        np.column_stack(values[has_time + k * n_joints : has_time + (k + 1) * n_joints])
        for k in range(n_rest // n_joints)
    ]
    lines = ["header = false"] if has_time else ["header = false", "rate = 100  # Hz"]
    lines.append("[columns]")
    if has_time:
        lines.append("time = 1")
    position, velocity = _position_and_velocity(t, groups)
    rest = [k for k in range(len(groups)) if k not in (position, velocity)]
    span = {
        k: f'"{has_time + k * n_joints + 1}-{has_time + (k + 1) * n_joints}"'
        for k in range(len(groups))
    }
    lines.append(f"position = {span[position]}")
    if velocity is not None:
        lines.append(f"velocity = {span[velocity]}")
    if rest:
        also = f"  # or {', '.join(span[k] for k in rest[1:])}" if len(rest) > 1 else ""
        lines.append(f"torque = {span[rest[0]]}{also}")
    over = n_rest - n_joints * len(groups)
    if over:
        lines.append(f"# {over} more columns follow")
    return "\n".join(lines)


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
