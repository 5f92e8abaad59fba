"""Samples at which the torque limit of a position servo hides its law."""

from __future__ import annotations

import numpy as np

from asbuilt.arrays import Mask
from asbuilt.experiment.command.servo_torque import logged_velocity
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples


def saturated(recording: Recording) -> Mask:
    """Return where a joint's servo is at its torque limit, shape (N, n)."""
    if recording.servo is None:
        return np.zeros(recording.q.shape, dtype=np.bool_)
    limit = np.asarray(recording.servo.torque_limit)
    # Share of the torque limit from which the servo counts as saturated.
    slack = np.where(np.isfinite(limit), (1.0 - 0.999) * limit, 0.0)
    low, high = recording.servo.bounds(logged_velocity(recording))
    return np.asarray((recording.tau >= high - slack) | (recording.tau <= low + slack))


def outside_saturation(samples: Samples, recording: Recording) -> Samples:
    """Return the samples at which no servo is at its torque limit."""
    limited = np.any(saturated(recording), axis=1)
    if not np.any(limited):
        return samples
    half = 0.5 / samples.rate + 0.5 / recording.rate
    at = np.sort(recording.t[limited])
    near = np.searchsorted(at, samples.t - half)
    distance = at[np.minimum(near, at.size - 1)] - samples.t
    return samples.select(~(np.abs(distance) <= half))
