"""Running statistics of a log that is watched part by part."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from asbuilt.arrays import Array
from asbuilt.monitoring.events import payload_change
from asbuilt.monitoring.observed import Observed
from asbuilt.monitoring.observer import Observer
from asbuilt.monitoring.sensitivity import smallest_forces
from asbuilt.monitoring.thresholds import sampling_rates


@dataclass(slots=True)
class Tally:
    """Gather what is said of a whole log.

    Parameters
    ----------
    joint_names
        The n joints.
    tool
        Link that carries the tool, counted from 0, and pose (4, 4) of the tool's frame in it.
    filtered
        Whether positions and torques went through the causal filter.
    n_samples, left_out, seconds
        Valid rows, others, and duration [s], gaps left out.
    """

    joint_names: tuple[str, ...]
    tool: tuple[int, Array]
    filtered: bool
    n_samples: int = 0
    left_out: int = 0
    seconds: float = 0.0
    tops: list[Array] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    sizes: list[Array] = field(default_factory=list)
    forces: list[Array] = field(default_factory=list)
    masses: list[tuple[float, float] | None] = field(default_factory=list)

    def add(self, observer: Observer, observed: Observed, scale: Array, limit: Array) -> None:
        """Count one more part, with scale and threshold (N, n) of its residual."""
        steps = np.diff(observed.t)
        self.n_samples += len(observed.t)
        self.left_out += observed.left_out
        self.seconds += float(steps[observed.share[1:] > 0.0].sum())
        self.tops.append(np.abs(observed.qd).max(axis=0))
        if not steps.size:
            return
        self.rates.append(float(np.median(sampling_rates(observed.t))))
        # Median of the absolute value of a standard normal variable.
        self.sizes.append(np.median(np.abs(observed.residual), axis=0) / 0.6745)
        self.forces.append(
            smallest_forces(observer, observed, limit, self.tool, filtered=self.filtered)
        )
        self.masses.append(payload_change(observer, observed, scale, self.tool[0]))

    @property
    def top_speed(self) -> Array:
        """Highest speeds (n,) [rad/s or m/s]."""
        return np.asarray(np.max(self.tops, axis=0))

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return float(np.median(self.rates))

    @property
    def size(self) -> Array:
        """Robust standard deviation of the residual about 0 (n,) [N m or N]."""
        return np.asarray(np.median(self.sizes, axis=0))

    @property
    def smallest_force(self) -> float:
        """Median of the forces at the tool [N] that are found within 20 ms."""
        return float(np.median(np.concatenate(self.forces)))

    @property
    def mass(self) -> tuple[float, float] | None:
        """Change of mass [kg] and its error, if one explains every part of the log."""
        known = [mass for mass in self.masses if mass is not None]
        if len(known) < len(self.masses):
            return None
        values, errors = np.array(known).T
        return float(np.median(values)), float(max(np.median(errors), np.ptp(values) / 2.0))
