"""Samples that determine the law of a position servo: not saturated, direction of motion known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.arrays import Mask
from asbuilt.experiment.command.servo_torque import differentiate_logged_positions
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples


def find_saturated(recording: Recording) -> Mask:
    """Return where a joint's servo is at its torque limit, shape (N, n)."""
    if recording.servo is None:
        return np.zeros(recording.q.shape, dtype=np.bool_)
    limit = np.asarray(recording.servo.torque_limit)
    # Share of the torque limit from which the servo counts as saturated.
    slack = np.where(np.isfinite(limit), (1.0 - 0.999) * limit, 0.0)
    low, high = recording.servo.bounds(differentiate_logged_positions(recording))
    return np.asarray((recording.tau >= high - slack) | (recording.tau <= low + slack))


def drop_saturated(samples: Samples, recording: Recording) -> Samples:
    """Return the samples at which no servo is at its torque limit."""
    limited = np.any(find_saturated(recording), axis=1)
    if not np.any(limited):
        return samples
    half = 0.5 / samples.rate + 0.5 / recording.rate
    at = np.sort(recording.t[limited])
    near = np.searchsorted(at, samples.t - half)
    distance = at[np.minimum(near, at.size - 1)] - samples.t
    return samples.select(~(np.abs(distance) <= half))


def estimate_direction_speeds(recording: Recording, cutoff: float) -> tuple[float, ...]:
    """Return the speed of each joint below which its direction is unknown [rad/s or m/s].

    An encoder with steps s has errors up to s / 2; low-passed at f they are velocities up to
    `pi f s`. A position servo that stands still there holds any torque up to dry friction.

    Examples
    --------
    >>> t = np.arange(0.0, 2.0, 0.01)
    >>> q = np.round(np.sin(t) / 0.001)[:, None] * 0.001
    >>> round(estimate_direction_speeds(Recording(t=t, q=q, tau=q), cutoff=10.0)[0], 4)
    0.0314
    """
    changes = np.abs(np.diff(recording.q, axis=0))
    steps = []
    for change in changes.T:
        moved = change[np.isfinite(change) & (change > 1e-12 * np.nanmax(np.abs(recording.q)))]
        # Percentile of the changes of position that is taken as one step of an encoder.
        steps.append(float(np.percentile(moved, 1.0)) if moved.size else 0.0)
    return tuple(np.pi * cutoff * step for step in steps)


def drop_slow_rows(samples: Samples, recording: Recording, cutoff: float) -> Samples:
    """Return samples whose rows count only where the direction of a joint is known."""
    return replace(samples, slowest=estimate_direction_speeds(recording, cutoff))
