"""What drives a simulation: commanded positions, held, or torques, interpolated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.experiment.recording import Recording

DrivenBy = Literal["command", "torque"]

BEYOND = 1e3
"""Time [s] for which the first and the last value are held before and after the log."""


@dataclass(frozen=True, eq=False)
class DriveSignal:
    """Hold a logged signal of n joints as a function of time.

    Parameters
    ----------
    kind
        A commanded position is held until the next one, a torque is interpolated.
    t
        Times [s], increasing, shape (K,).
    values
        Shape (K, n).
    goal
        What a servo that limits its goal makes of the command, as `goal_path` returns it; None if
        the command is the goal.
    """

    kind: DrivenBy
    t: Array
    values: Array
    goal: tuple[Array, Array] | None = None

    @classmethod
    def of(cls, recording: Recording, kind: DrivenBy) -> DriveSignal:
        """Return the command or torque of a recording, without samples that are not finite."""
        logged = recording.tau if kind == "torque" else recording.command
        if logged is None:
            raise ValueError(f"{recording.source} has no {kind}")
        there = np.isfinite(recording.t) & np.all(np.isfinite(logged), axis=1)
        t, first = np.unique(recording.t[there], return_index=True)
        values, servo = logged[there][first], recording.servo
        limited = kind == "command" and servo is not None and servo.limits_goal
        return cls(kind, t, values, servo.goal(t, values) if limited and servo else None)

    @property
    def _held(self) -> tuple[Array, Array]:
        """Times (M,) and values (M, n) of what the servo holds until the next."""
        return (self.t, self.values) if self.goal is None else self.goal

    @cached_property
    def _sums(self) -> tuple[Array, Array]:
        """Times (M + 2,), and the integrals of the held signal up to them, (n, M + 2)."""
        times, values = self._held
        t = np.concatenate([[times[0] - BEYOND], times, [times[-1] + BEYOND]])
        held = np.concatenate([values[:1], values])
        sums = np.cumsum(held * np.diff(t)[:, None], axis=0)
        return t, np.vstack([np.zeros((1, held.shape[1])), sums]).T.copy()

    def means(self, starts: Array, steps: int, step: float, delay: float = 0.0) -> Array:
        """Return the mean of the delayed signal over each time step, shape (W, steps, n).

        Step k of window w lasts from `starts[w] + k step` to `starts[w] + (k + 1) step`. For a
        held signal the mean is exact, so it is continuous in the delay.
        """
        edges = starts[:, None] + step * np.arange(steps + 1) - delay
        if self.kind == "torque":
            middles = edges[:, :-1] + 0.5 * step
            return np.stack([np.interp(middles, self.t, x) for x in self.values.T], axis=-1)
        t, sums = self._sums
        integrals = np.stack([np.interp(edges, t, x) for x in sums], axis=-1)
        return np.asarray(np.diff(integrals, axis=1) / step)

    def slopes(self, starts: Array, steps: int, step: float, delay: float = 0.0) -> Array:
        """Return the derivative of `means` of a held signal by the delay, shape (W, steps, n)."""
        edges = starts[:, None] + step * np.arange(steps + 1) - delay
        times, values = self._held
        at = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, len(times) - 1)
        return np.asarray(-np.diff(values[at], axis=1) / step)
