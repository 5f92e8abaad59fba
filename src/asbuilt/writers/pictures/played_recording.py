"""Motion of a recording, as a robot plays it in a picture."""

from __future__ import annotations

import numpy as np

from asbuilt.errors import MotionError
from asbuilt.excitation.motions.spline import SplineMotion
from asbuilt.experiment.logs.long_recordings import RecordingStream, head_of
from asbuilt.experiment.recording import Recording

PLAYED_RATE = 25.0
"""Poses per second [Hz]; the eye sees no more."""
MOST_POSES = 3000
"""Poses of a motion: two minutes; a longer one is played in larger steps."""
FEWEST_POSES = 6


def motion_of_recording(recording: Recording | RecordingStream) -> SplineMotion:
    """Return the motion through the positions of a recording, of the beginning of a long one.

    Raises `MotionError` if there are fewer than 6 samples without gaps.
    """
    head = head_of(recording)
    valid = np.all(np.isfinite(head.q), axis=1) & np.isfinite(head.t)
    t, q = head.t[valid], head.q[valid]
    if len(t) < FEWEST_POSES:
        raise MotionError(f"{head.source} has {len(t)} valid positions; at least 6 can be played")
    wanted = max(FEWEST_POSES, min(MOST_POSES, int(PLAYED_RATE * (t[-1] - t[0]))))
    chosen = np.unique(np.linspace(0, len(t) - 1, wanted).round().astype(int))
    return SplineMotion.through(q[chosen], t[chosen] - t[0], degree=3, ends="natural")
