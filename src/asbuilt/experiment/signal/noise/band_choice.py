"""Default cutoff of the positions: what the motion asks for, less what noise takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.experiment.signal.noise.bandwidth import motion_bandwidth
from asbuilt.experiment.signal.noise.noise_limit import NoiseLimit, noise_limit
from asbuilt.experiment.signal.resampling import UniformSegment

POSITION_BANDWIDTHS = 10.0
"""Default position cutoff, in bandwidths of the motion."""
LOWEST_CUTOFF = 7.0
"""Lowest default cutoff [Hz] where noise of the positions does not demand a lower one.

Friction changes sign within a tenth of a second. Tuned on recordings of UR10e, LWR4+, Med 7,
AIRBOT, Rokae and TX40; none was kept apart to test it.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Hold the bandwidth of a motion, the cutoff for it, and the one that noise leaves, in Hz.

    `noise` is None for a recording too short for its spectra.
    """

    bandwidth: float
    wanted: float
    cutoff: float
    noise: NoiseLimit | None

    @property
    def limited(self) -> bool:
        """Whether noise of the log limits the band, not the motion."""
        return self.cutoff < self.wanted

    def __str__(self) -> str:
        limited = f"; noise in the log limits the band, wanted were {self.wanted:.3g} Hz"
        return (
            f"95 % of the velocity's power lies below {self.bandwidth:.3g} Hz; positions are kept"
            f" up to {self.cutoff:.3g} Hz{limited if self.limited else ''}"
        )


def choose_band(
    segments: Sequence[UniformSegment],
    rate: float,
    *,
    of_velocity: bool = False,
    commanded: bool = False,
) -> Band:
    """Return the default cutoff of segments at one rate [Hz].

    The torque of a command contains the positions and their noise, so that it is no measure of
    them; if it is `commanded`, noise demands no cutoff below `LOWEST_CUTOFF`. A lower one turns the
    phase by which stiffness and delay of the servo are found. With `of_velocity` the noise is that
    of the logged velocities, from which accelerations follow.
    """
    moved = [
        np.cumsum(segment.qd, axis=0) / rate
        if of_velocity and segment.qd is not None
        else segment.q
        for segment in segments
    ]
    bandwidth = motion_bandwidth(moved, rate)
    # Highest default cutoff, as a share of the sampling rate.
    wanted = min(max(POSITION_BANDWIDTHS * bandwidth, LOWEST_CUTOFF), 0.2 * rate)
    logged = [(segment.qd if of_velocity else segment.q, segment.tau) for segment in segments]
    noise = noise_limit(
        [(x, tau) for x, tau in logged if x is not None], rate, of_velocity=of_velocity
    )
    cutoff = wanted if noise is None else noise.cutoff(wanted)
    if commanded:
        cutoff = max(cutoff, min(wanted, LOWEST_CUTOFF))
    return Band(bandwidth, wanted, cutoff, noise)
