"""Checks of the positions' resolution and noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.noise.band_choice import POSITION_BANDWIDTHS, Band, choose_band
from asbuilt.experiment.signal.noise.position_step import position_steps
from asbuilt.experiment.signal.resampling import uniform_segments
from asbuilt.findings import Cure, Finding

MEASURED = 20_000
"""Samples at the beginning by which step and noise are measured: 20 s at 1 kHz."""
COARSE = 2.0 * np.pi / 2**16
"""Step [rad or m] beyond which positions are called coarse: 16 bits per turn."""
LIMITED = 0.8
"""Share of the cutoff wanted below which noise of the positions limits the band."""
CURE = Cure("log positions with the encoder's full resolution, or velocities, or move faster")


@dataclass(frozen=True, eq=False)
class PositionNoise:
    """Hold step and noise of the positions of each joint.

    Parameters
    ----------
    step
        Step of the values [rad or m], 0 where none was found, (n,).
    density
        Spectrum of the noise about the default cutoff [rad^2/Hz], at least the step^2 / (6 rate) of
        white quantisation noise (Bennett, Bell System Technical Journal, 1948), (n,).
    band
        The default cutoff.
    """

    step: Array
    density: Array
    band: Band

    @classmethod
    def of(cls, recording: Recording) -> PositionNoise | None:
        """Measure a recording; None if no segment can be used, or no position changes."""
        try:
            segments, rate, _ = uniform_segments(recording)
        except RecordingError:
            return None
        finite = recording.q[np.all(np.isfinite(recording.q), axis=1)]
        changed = np.any(np.diff(finite, axis=0) != 0.0, axis=1)
        if rate < 1.0 or not changed.any():
            return None
        band = choose_band(segments, rate, commanded=recording.torque_source == "command")
        step = position_steps([finite[np.concatenate([[True], changed])]])
        density = np.zeros(len(step)) if band.noise is None else band.noise.density(band.cutoff)
        return cls(step, np.maximum(density, step**2 / (6.0 * rate)), band)


def position_findings(model: RobotModel, noise: PositionNoise | None) -> Iterator[Finding]:
    """Find positions of coarse steps, and noise that limits the band."""
    if noise is None:
        return
    steps = [_step_text(model, k, step) for k, step in enumerate(noise.step.tolist())]
    band = noise.band
    if band.noise is not None and band.cutoff < LIMITED * band.wanted:
        worst = band.noise.limiting_joint(band.wanted)
        cuts_motion = band.cutoff < LIMITED * POSITION_BANDWIDTHS * band.bandwidth
        by_steps = f", whose positions change in {steps[worst]}" if steps[worst] else ""
        yield Finding(
            "band_limited_by_noise",
            "warning" if steps[worst] and cuts_motion else "info",
            f"Noise of the positions, not the motion, limits the low-pass to {band.cutoff:.2g} Hz,"
            f" most of all that of {model.joint_names[worst]}{by_steps}; faster parts of the motion"
            " determine nothing",
            CURE,
        )
    for k, text in enumerate(steps):
        if text and noise.step[k] > COARSE:
            yield Finding(
                "coarse_positions",
                "info",
                f"positions change in {text}",
                joint=model.joint_names[k],
            )


def _step_text(model: RobotModel, joint: int, step: float) -> str:
    if step <= 0.0:
        return ""
    if not model.joints[joint].is_revolute:
        return f"steps of {1e3 * step:.3g} mm"
    return f"steps of {1e3 * step:.3g} mrad ({2.0 * np.pi / step:.0f} per turn)"
