"""Evidence of gravity in torques: whether columns follow its torque at positions in rad or deg."""

from __future__ import annotations

from typing import Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel

CLEAR_LOAD = 0.5
"""Correlation with gravity's torque from which a group is taken for torques."""
CLEARLY_BETTER = 0.1
"""Correlation with gravity's torque by which positions are rather degrees than radians."""


CLEAR_SHARE = 0.3
"""Share of the torques' variance that gravity must explain in the right unit alone."""
LARGEST_RADIANS = 4 * np.pi
"""Positions beyond are degrees: few axes turn twice either way."""
DEGREE = np.pi / 180
"""A degree in radians."""


def match_load(model: RobotModel, q: Array, columns: list[Array], scale: float) -> Array:
    """Return how each of several groups (N, n) follows gravity's torque at `scale * q` (N, n).

    The median magnitude of the correlation over the joints that carry much of the load; 0 where the
    positions are none.
    """
    step, load = _evaluate_load(model, q, scale)
    return np.array([0.0 if load is None else _correlate(load, tau[::step]) for tau in columns])


def infer_unit_by_gravity(model: RobotModel, q: Array, tau: Array) -> Literal["rad", "deg"] | None:
    """Return the unit of positions (N, n) that torques (N, n) support, None if neither clearly.

    Gravity's torque at the right positions is most of the torque [N m], with either sign; torques
    in another unit can only correlate with it.
    """
    if not all(joint.is_revolute for joint in model.joints):
        return None
    evidence = []
    for scale in (1.0, DEGREE):
        step, load = _evaluate_load(model, q, scale)
        rows = tau[::step]
        evidence.append(
            (0.0, 0.0) if load is None else (_explain(load, rows), _correlate(load, rows))
        )
    shares, matches = zip(*evidence, strict=True)
    for (plain, turned), least, apart in (
        (shares, CLEAR_SHARE, CLEAR_SHARE),
        (matches, CLEAR_LOAD, CLEARLY_BETTER),
    ):
        if max(plain, turned) > least and abs(plain - turned) > apart:
            return "rad" if plain > turned else "deg"
    return None


def _evaluate_load(model: RobotModel, q: Array, scale: float) -> tuple[int, Array | None]:
    """Return gravity's torque at every `step`th row, None where the positions are none."""
    from asbuilt.dynamics.newton_euler import gravity_torque  # noqa: PLC0415 - light start

    # 2000 samples are looked at; positions beyond 400 are neither radians nor degrees.
    step = max(1, q.shape[0] // 2000)
    rows = q[::step]
    if not np.all(np.isfinite(rows)) or np.abs(rows).max() > 400.0:
        return step, None
    return step, gravity_torque(model, scale * rows)


def _correlate(load: Array, tau: Array) -> float:
    """Return the median magnitude of correlations with a load (N, n), where that is heavy."""
    # A joint carries load from a tenth of the largest joint's range on.
    heavy = np.ptp(load, axis=0) > 0.1 * max(float(np.ptp(load, axis=0).max()), 1e-9)
    return float(np.median(np.abs(correlations(load[:, heavy], tau[:, heavy]))))


def _explain(load: Array, tau: Array) -> float:
    """Return the share of the torques' variance that a load explains, at least 0."""
    x = load - load.mean(axis=0)
    y = tau - tau.mean(axis=0)
    power = float(np.sum(y**2))
    rest = min(float(np.sum((y - sign * x) ** 2)) for sign in (1.0, -1.0))
    return max(0.0, 1.0 - rest / power) if power > 0.0 else 0.0


def correlations(one: Array, other: Array) -> list[float]:
    """Return the correlations of columns (N, n) that both vary; a single 0 if none does."""
    found = []
    for a, b in zip(one.T, other.T, strict=True):
        ok = np.isfinite(a) & np.isfinite(b)
        if ok.sum() > 10 and np.std(a[ok]) > 0 and np.std(b[ok]) > 0:
            found.append(float(np.corrcoef(a[ok], b[ok])[0, 1]))
    return found or [0.0]
