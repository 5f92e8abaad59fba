"""Check of a log before it is learned, and before another motion is sent."""

from __future__ import annotations

import numpy as np

import asbuilt
from asbuilt import Recording, RecordingError, RobotModel
from asbuilt.arrays import Array
from asbuilt.excitation import Motion
from asbuilt.findings import Cure

FOLLOWED = 0.4
"""RMS distance of a joint from the motion, in standard deviations of the motion, that a log may
have at the best shift in time; controllers lag by less, other motion is farther off by 1."""
STILL = 0.02
"""Standard deviation [rad or m] below which a joint need not follow: as good as at rest."""
RATE = 50.0
"""Rate at which log and motion are compared [Hz]; no arm moves a radian between two samples."""
SHORTER = 0.9
"""Share of the motion that a log must last."""


def check_log(model: RobotModel, recording: Recording, motion: Motion) -> None:
    """Raise `RecordingError` unless a log is sound, and of the motion that was sent.

    It may begin before the motion and end after it.
    """
    asbuilt.check_recording(model, recording).raise_errors()
    cure = Cure("run the motion of this round to its end, and give its log")
    if recording.duration < SHORTER * motion.duration:
        raise RecordingError(
            f"{recording.source} lasts {recording.duration:.3g} s, the motion that was sent"
            f" {motion.duration:.3g} s",
            cure=cure,
        )
    distance = measure_distance(recording, motion)
    joint = int(np.argmax(distance))
    if distance[joint] > FOLLOWED:
        raise RecordingError(
            f"{recording.source} is not a log of the motion that was sent:"
            f" {model.joint_names[joint]} is off by {100 * distance[joint]:.0f} % of the size of"
            " its motion",
            cure=cure,
            joint=model.joint_names[joint],
        )


def measure_distance(recording: Recording, motion: Motion) -> Array:
    """Return the RMS distance of each joint (n,) from a motion, in standard deviations of it.

    At the shift in time at which all joints together are closest, and without a constant offset,
    as servos sag; zero where a joint rests.
    """
    sent = motion.derivative(motion.sample_times(RATE))
    t = np.arange(recording.t[0], recording.t[-1], 1.0 / RATE)
    logged = np.stack([np.interp(t, recording.t, column) for column in recording.q.T], axis=1)
    sent = sent[: len(logged)]
    size = sent.std(axis=0)
    scale = np.where(size > STILL, 1.0 / np.maximum(size, STILL), 0.0)
    a = logged * scale
    b = (sent - sent.mean(axis=0)) * scale
    sums = _add_windows(a, len(b))
    energy = _add_windows(a**2, len(b))
    cross = [np.correlate(x, y, "valid") for x, y in zip(a.T, b.T, strict=True)]
    # |a - mean a - b|^2 = |a|^2 - |sum a|^2 / N - 2 a.b + |b|^2 of every shift at once.
    squares = energy - sums**2 / len(b) - 2.0 * np.stack(cross, axis=1) + np.sum(b**2, axis=0)
    best = squares[int(np.argmin(squares.sum(axis=1)))]
    return np.asarray(np.sqrt(np.maximum(best, 0.0) / len(b)))


def _add_windows(values: Array, length: int) -> Array:
    """Return the sums of all windows of a length, of each column."""
    running = np.cumsum(np.vstack([np.zeros(values.shape[1]), values]), axis=0)
    return np.asarray(running[length:] - running[:-length])
