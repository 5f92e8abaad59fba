"""Smallest forces that an observer finds in a given time."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Array
from asbuilt.monitoring.contact import frame_jacobian
from asbuilt.monitoring.observed import Observed
from asbuilt.monitoring.observer import Observer
from asbuilt.monitoring.thresholds import HALF

WITHIN = 0.020
"""Time [s] in which a collision is to be found."""
POSES = 40
LEAST_TORQUE = 1e-9
"""Torque per newton below which a joint does not feel a force."""


def smallest_forces(
    observer: Observer,
    observed: Observed,
    limit: Array,
    tool: tuple[int, Array],
    *,
    filtered: bool,
    within: float = WITHIN,
) -> Array:
    """Return the smallest steps of force [N] at the tool that alarm in time, in some poses (m,).

    The residual is linear in the external torque, so a step of force adds its lagged share to the
    residual found without it, and a smaller share, as a step of torque, to the threshold.
    Directions are random, times are equally spaced.

    Parameters
    ----------
    observer, observed, limit
        The observer, what it made of a log, and thresholds (N, n).
    tool
        Link that carries the tool, counted from 0, and pose (4, 4) of the tool's frame in it.
    filtered
        Whether positions and torques went through the causal filter.
    within
        Time from the step to the alarm [s].
    """
    rng = np.random.default_rng(0)
    steps = np.diff(observed.t)
    pole, spacing = observer.pole(steps) if filtered else None, float(np.median(steps))
    share = excess_response(observer, within, spacing, pole)
    found = []
    for k in np.unique(np.linspace(0.1, 0.9, POSES) * (len(observed.t) - 1)).astype(int):
        along = rng.normal(size=3)
        along /= np.linalg.norm(along)
        torque = frame_jacobian(observer.model, observed.q[k], *tool)[3:].T @ along
        left = limit[k] - np.sign(torque) * observed.residual[k]
        felt = np.abs(torque) > LEAST_TORQUE
        if felt.any():
            found.append(max(float(np.min(left[felt] / np.abs(torque[felt]))) / share, 0.0))
    return np.array(found)


def excess_response(observer: Observer, time: float, spacing: float, pole: float | None) -> float:
    """Return what a step of external torque adds to the residual, less to the threshold, in `time`.

    The lagged size of the steps of torque between samples of a `spacing` [s] is the change of the
    step response within one of them.
    """
    now, before = (step_response(observer, max(at, 0.0), pole) for at in (time, time - spacing))
    return now - HALF * (now - before)


def step_response(observer: Observer, time: float, pole: float | None) -> float:
    """Return the share of a step of external torque in the residual after `time` [s].

    `1 - exp(-K t)` of the observer; behind the causal filter with its double pole w [rad/s] the
    inverse Laplace transform of `K w^2 / (s (s + K) (s + w)^2)`.

    >>> import asbuilt
    >>> observer = Observer(asbuilt.load_robot("two-link"), bandwidth=8.0)
    >>> round(step_response(observer, 0.02, None), 3), round(step_response(observer, 0.02, 200), 3)
    (0.634, 0.386)
    """
    gain = 2.0 * np.pi * observer.bandwidth
    if pole is None:
        return float(-np.expm1(-gain * time))
    w = pole if abs(pole / gain - 1.0) > 1e-3 else 1.001 * gain
    slow, double = (w / (w - gain)) ** 2, gain * w / (w - gain)
    faded = (slow - 1.0 + double * time) * np.exp(-w * time)
    return float(1.0 - slow * np.exp(-gain * time) + faded)
