"""Check of a log before it is learned, and before another motion is sent."""

from __future__ import annotations

import numpy as np

import asbuilt
from asbuilt import Recording, RecordingError, RobotModel
from asbuilt.excitation import Motion
from asbuilt.findings import Cure

COVERED = 0.2
"""Share of a joint's range in the motion that its log may lack at either end; controllers lag."""
STILL = 0.02
"""Range of a joint in the motion [rad or m] below which it need not follow: as good as at rest."""
MOTION_RATE = 50.0
"""Rate at which the range of a motion is taken [Hz]."""


def check_log(model: RobotModel, recording: Recording, motion: Motion) -> None:
    """Raise `RecordingError` unless a log is sound, and of the motion that was sent."""
    asbuilt.check_recording(model, recording).raise_errors()
    sent = motion.derivative(motion.sample_times(MOTION_RATE))
    width = np.ptp(sent, axis=0)
    below = np.nanmin(recording.q, axis=0) - sent.min(axis=0)
    above = sent.max(axis=0) - np.nanmax(recording.q, axis=0)
    lacking = np.maximum(below, above) / np.maximum(width, STILL)
    joint = int(np.argmax(lacking))
    if lacking[joint] > COVERED:
        low, high = (float(each(recording.q[:, joint])) for each in (np.nanmin, np.nanmax))
        raise RecordingError(
            f"{recording.source} is not a log of the motion that was sent:"
            f" {model.joint_names[joint]} moves from {low:.3g} to {high:.3g}, the motion from"
            f" {sent[:, joint].min():.3g} to {sent[:, joint].max():.3g}",
            cure=Cure("run the motion of this round to its end and give its log, or its units"),
            joint=model.joint_names[joint],
        )
