"""Data logger: a rate, time stamps that jitter, samples that are lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError
from asbuilt.excitation.motions.motion import Trajectory
from asbuilt.experiment.virtual.sensors import PERFECT_SENSORS, SensorNoise


@dataclass(frozen=True, slots=True, eq=False)
class LoggedColumns:
    """Hold the columns of a log, each (N, n) but `t` (N,); None if not logged."""

    t: Array
    q: Array
    tau: Array
    q_command: Array
    qd: Array | None
    qdd: Array | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DataLogger:
    """Describe a logger.

    Parameters
    ----------
    rate
        Sampling rate [Hz].
    clock_jitter
        Standard deviation of the error of a time stamp [s].
    dropped, burst
        Fraction of the samples that is lost, and mean length of a burst of lost samples.
    accelerations
        Whether true velocities and accelerations are logged too, with perfect sensors only.

    Raises
    ------
    UsageError
        If a value is outside its range.
    """

    rate: float = 1000.0
    clock_jitter: float = 0.0
    dropped: float = 0.0
    burst: float = 3.0
    accelerations: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise UsageError(
                f"the rate of the logger must be a positive number of Hz, got {self.rate}",
                value=self.rate,
                lower=0.0,
            )
        if not 0.0 <= self.clock_jitter < 0.5 / self.rate:
            raise UsageError(
                f"clock_jitter must be below half a sampling period, {0.5 / self.rate:g} s at"
                f" {self.rate:g} Hz, got {self.clock_jitter}",
                value=self.clock_jitter,
                lower=0.0,
                upper=0.5 / self.rate,
            )
        if not (0.0 <= self.dropped < 1.0 and self.burst >= 1.0):
            raise UsageError(
                "dropped must be from 0 to below 1 and burst at least 1, got"
                f" {self.dropped} and {self.burst}",
                value=(self.dropped, self.burst),
            )

    def logged(
        self,
        model: RobotModel,
        sensors: SensorNoise,
        truth: Trajectory,
        tau: Array,
        command: Array,
        rng: np.random.Generator,
    ) -> LoggedColumns:
        """Return the log of a motion and its torque (N, n), sampled at a multiple of the rate."""
        every = round(1.0 / self.rate / (truth.t[1] - truth.t[0]))
        pick = slice(None, None, every)
        seen = Trajectory(truth.t[pick], truth.q[pick], truth.qd[pick], truth.qdd[pick])
        q, qd, torque = sensors.measured(model, seen, sensors.delayed(truth.t, tau)[pick], rng)
        t = seen.t.copy()
        if self.clock_jitter:
            slips = np.clip(
                self.clock_jitter * rng.standard_normal(t.size), -0.45 / self.rate, 0.45 / self.rate
            )
            t = t + slips - slips[0]
        perfect = sensors == PERFECT_SENSORS and self.accelerations
        columns = LoggedColumns(
            t=t,
            q=q,
            tau=torque,
            q_command=command[pick],
            qd=seen.qd if perfect else qd,
            qdd=seen.qdd if perfect else None,
        )
        return columns if not self.dropped else _without(columns, self._kept(t.size, rng))

    def _kept(self, n: int, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Return which samples are kept; bursts start at random and have geometric lengths."""
        keep = np.ones(n, dtype=np.bool_)
        starts = np.flatnonzero(rng.random(n) < self.dropped / self.burst)
        for start, length in zip(starts, rng.geometric(1.0 / self.burst, starts.size), strict=True):
            keep[start : start + length] = False
        keep[[0, -1]] = True
        return keep


def _without(columns: LoggedColumns, keep: NDArray[np.bool_]) -> LoggedColumns:
    qd, qdd = (None if values is None else values[keep] for values in (columns.qd, columns.qdd))
    return LoggedColumns(
        columns.t[keep], columns.q[keep], columns.tau[keep], columns.q_command[keep], qd, qdd
    )
