"""Windows of a recording in which its motion is simulated: where it starts, and what drives it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording, Samples
from asbuilt.experiment.root import root_of
from asbuilt.findings import Cure
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    choose_driving_signal,
    select_finite,
)

if TYPE_CHECKING:
    from asbuilt.experiment.free_base.ground import Ground

FEWEST = 3
"""Fewest samples of a window: the state at its start and two to compare."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Hold W windows of L samples of n joints, one after another.

    Attributes
    ----------
    source
        Name of the recording.
    horizon
        Length of a window [s].
    rate
        Sampling rate [Hz].
    starts
        Time of the first sample of each window [s], shape (W,).
    q
        Measured positions, unfiltered, shape (W, L, n).
    start_q, start_qd
        Measured state at the start, filtered, shape (W, n).
    signal
        What drives the simulation.
    ground
        What is under the feet; None if nothing is.
    longest_step
        Longest step of the simulation [s].
    """

    source: str
    horizon: float
    rate: float
    starts: Array
    q: Array
    start_q: Array
    start_qd: Array
    signal: DriveSignal
    ground: Ground | None = None
    # Longest step of a simulation [s]; a period of the log is divided into equal steps.
    longest_step: float = 1e-3

    @property
    def n_windows(self) -> int:
        """Number of windows."""
        return len(self.starts)

    @property
    def n_samples(self) -> int:
        """Number of samples in each window, the first included."""
        return int(self.q.shape[1])

    @property
    def times(self) -> Array:
        """Times of the samples since the start of the window [s], shape (L,)."""
        return np.arange(self.n_samples) / self.rate

    @property
    def divisions(self) -> int:
        """Number of simulation steps per sample."""
        return max(1, math.ceil(1.0 / (self.rate * self.longest_step) - 1e-9))

    @property
    def step(self) -> float:
        """Step of the simulation [s]."""
        return 1.0 / (self.rate * self.divisions)

    @property
    def n_steps(self) -> int:
        """Number of simulation steps of a window."""
        return self.divisions * (self.n_samples - 1)

    def some(self, part: slice | Indices) -> Windows:
        """Return some of the windows."""
        return replace(
            self,
            starts=self.starts[part],
            q=self.q[part],
            start_q=self.start_q[part],
            start_qd=self.start_qd[part],
            ground=self.ground and self.ground.some(part),
        )

    def inputs(self, delay: float = 0.0, lead: ArrayLike = 0.0) -> Array:
        """Return the mean of the delayed signal over each simulation step, (W, n_steps, n).

        A lead [s], one or (n,), adds the rate of the means times itself.
        """
        if not np.any(lead):
            return self.signal.means(self.starts, self.n_steps, self.step, delay)
        means = self._from_one_before(delay)
        return means[:, 1:] + np.asarray(lead) * (np.diff(means, axis=1) / self.step)

    def rates(self, delay: float) -> Array:
        """Return the rate of the delayed signal from step to step, shape (W, n_steps, n)."""
        return np.diff(self._from_one_before(delay), axis=1) / self.step

    def _from_one_before(self, delay: float) -> Array:
        """Return the mean of the delayed signal over a step before the first, and over each."""
        return self.signal.means(self.starts - self.step, self.n_steps + 1, self.step, delay)

    def slopes(self, delay: float, lead: ArrayLike = 0.0) -> Array:
        """Return the derivative of `inputs` of a held signal by the delay, (W, n_steps, n)."""
        here = (self.starts, self.n_steps, self.step)
        slopes = self.signal.slopes(*here, delay)
        if not np.any(lead):
            return slopes
        before = self.signal.slopes(*here, delay + self.step)
        return slopes + np.asarray(lead) * (slopes - before) / self.step


def cut_windows(
    recording: Recording,
    samples: Samples,
    horizon: float,
    signal: DriveSignal | None = None,
    model: RobotModel | None = None,
) -> Windows:
    """Cut the segments of samples into windows, one after another; what is left over is dropped.

    Parameters
    ----------
    recording
        The recording as logged.
    samples
        Its filtered motion, as far as it may be simulated.
    horizon
        Length of a window [s].
    signal
        What drives the simulation; None: `choose_driving_signal`.
    model
        The robot, whose feet the log shows to stand on a ground; None: there is none.

    Raises
    ------
    UsageError
        If the horizon is shorter than three samples.
    RecordingError
        If no segment is as long as the horizon.
    """
    length = round(horizon * samples.rate) if np.isfinite(horizon) else 0
    if length < FEWEST:
        raise UsageError(
            f"a rollout of {horizon:g} s has {max(length, 0)} samples at {samples.rate:.4g} Hz; it"
            f" needs {FEWEST}",
            value=horizon,
            lower=FEWEST / samples.rate,
        )
    first = [
        start for begin, end in samples.segments for start in range(begin, end - length + 1, length)
    ]
    if not first:
        longest = max((b - a) / samples.rate for a, b in samples.segments)
        raise RecordingError(
            f"{samples.source}: no segment is as long as a rollout of {horizon:g} s; the longest"
            f" lasts {longest:.3g} s",
            cure=Cure("give a shorter horizon, or hold out longer blocks"),
            file=samples.source,
            value=longest,
            lower=horizon,
        )
    at = np.array(first)[:, None] + np.arange(length)
    starts = samples.t[first]
    ground = None if model is None else root_of(model).measure_ground(recording, starts, horizon)
    return Windows(
        samples.source,
        horizon,
        samples.rate,
        starts,
        _interpolate_positions(recording, samples.t)[at],
        samples.q[first],
        samples.qd[first],
        signal or choose_driving_signal(recording),
        ground,
    )


def _interpolate_positions(recording: Recording, t: Array) -> Array:
    """Return the logged positions at times (N,), interpolated, shape (N, n)."""
    times, q = select_finite(recording.t, recording.q)
    return np.stack([np.interp(t, times, x) for x in q.T], axis=1)
