"""Delay of the torque of a recording: estimate, standard error, and what was applied."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.experiment.recording import Recording
from asbuilt.tables import round_with_error


@dataclass(frozen=True, slots=True)
class JointDelay:
    """Hold the delay of one joint [s]: estimate, standard error, and what was applied."""

    joint: str
    estimate: float
    std_error: float
    applied: float


@dataclass(frozen=True, slots=True)
class RecordingDelay:
    """Hold the time [s] by which the torque of a recording is late against position.

    `estimate` and `std_error` are NaN if it was stated. `applied` was taken out of the torque, the
    mean over joints if `joints` have their own. `digest` is the fingerprint of the recording.
    """

    source: str
    digest: str
    estimate: float
    std_error: float
    applied: float
    joints: tuple[JointDelay, ...] = ()

    @property
    def delays(self) -> tuple[float, ...]:
        """What was applied [s], one number or one per joint; empty for none."""
        applied = tuple(joint.applied for joint in self.joints) or (self.applied,)
        return applied if any(applied) else ()

    @property
    def errors(self) -> tuple[float, ...]:
        """Standard errors of what was estimated and applied [s]; empty for none."""
        if not self.delays or np.isnan(self.estimate):
            return ()
        return tuple(joint.std_error for joint in self.joints) or (self.std_error,)

    @property
    def text(self) -> str:
        """Estimate and standard error in ms, as text."""
        if np.isnan(self.estimate):
            return f"{1e3 * self.applied:.4g} ms (stated)" if self.applied else "none"
        if not np.isfinite(self.std_error):
            return "undetermined (not applied)"
        shown = " +- ".join(round_with_error(1e3 * self.estimate, 1e3 * self.std_error))
        return f"{shown} ms{'' if self.applied else ' (not applied)'}"


def state_delay(recording: Recording, digest: str, delays: tuple[float, ...]) -> RecordingDelay:
    """Return a delay that was given, one number or one per joint [s]."""
    own = delays if len(delays) > 1 else ()
    return RecordingDelay(
        recording.source,
        digest,
        np.nan,
        np.nan,
        float(np.mean(delays)) if delays else 0.0,
        joints=tuple(
            JointDelay(name, np.nan, np.nan, delay)
            for name, delay in zip(recording.joint_names, own, strict=True)
        )
        if own
        else (),
    )
