"""Signal chain: how recordings become the samples that identification uses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from asbuilt.errors import UsageError
from asbuilt.ranges import check_choice

Derivative = Literal["central", "gaussian", "savitzky-golay", "spline"]
Velocity = Literal["auto", "measured", "derived"]
Delay = float | tuple[float, ...] | Literal["auto"] | None
LONGEST_DELAY = 1.0
"""Longest delay [s]; a log further apart has two clocks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalChain:
    """Say how recordings become samples; what is None is chosen from the recording.

    Parameters
    ----------
    cutoff
        Cutoff [Hz] of the low-pass of the positions, a Butterworth filter forwards and backwards.
    parallel_cutoff
        Cutoff [Hz] of the parallel filter, by default half of `cutoff`.
    decimate
        Number of logged samples per row in the end.
    rate
        Rate [Hz] to which the recording is resampled.
    derivative
        How velocity and acceleration follow from positions. Where feet touch down and lift,
        "central" is "gaussian": differences as well, by a low-pass whose response ends.
    velocity
        Whether logged velocities are used; "auto" compares them with the derivative.
    parallel
        Whether torque and regressor columns are low-passed alike; if not, the torque stays as it
        is.
    order
        Order of the Butterworth filter.
    corrected
        Whether `cutoff` is the -3 dB frequency of both passes, not of each.
    trimmed
        Whether the ends, which the low-pass disturbs, are dropped.
    max_gap
        Longest pause [s] that is bridged; by default a quarter of a period of `cutoff`, and at
        least 4.5 sampling periods.
    rests
        Whether segments in which all joints are at rest are kept.
    standstill
        Speed of each joint below which, for 0.5 s or more, velocity and acceleration are zero.
    delay
        Time [s] by which logged torques are late against positions, one for all joints or each;
        they are shifted back by it. "auto": estimated with a model where recordings are prepared
        for one, else none. None: none.

    Raises
    ------
    UsageError
        If a number is not positive, or a choice is unknown.

    Examples
    --------
    >>> SignalChain.preset("paper2015").cutoff, SignalChain(cutoff=5.0).derivative
    (7.0, 'central')
    """

    cutoff: float | None = None
    parallel_cutoff: float | None = None
    decimate: int | None = None
    rate: float | None = None
    derivative: Derivative = "central"
    velocity: Velocity = "auto"
    parallel: bool = True
    order: int = 4
    corrected: bool = True
    trimmed: bool = True
    max_gap: float | None = None
    rests: bool = False
    standstill: tuple[float, ...] | None = None
    delay: Delay = "auto"

    def __post_init__(self) -> None:
        chosen = {
            "derivative": ("central", "gaussian", "savitzky-golay", "spline"),
            "velocity": ("auto", "measured", "derived"),
        }
        numbers = {
            name: getattr(self, name)
            for name in ("cutoff", "parallel_cutoff", "rate", "max_gap")
            if getattr(self, name) is not None
        }
        if isinstance(self.delay, str) and self.delay != "auto":
            raise UsageError(f"delay must be 'auto', None or seconds, got {self.delay!r}")
        for value in self.delays:
            if not abs(value) <= LONGEST_DELAY:
                raise UsageError(
                    f"a delay must be between -{LONGEST_DELAY:g} and {LONGEST_DELAY:g} s, got"
                    f" {value:g} s",
                    value=value,
                    lower=-LONGEST_DELAY,
                    upper=LONGEST_DELAY,
                )
        for name, value in numbers.items():
            if not (np.isfinite(value) and value > 0):
                raise UsageError(
                    f"{name} must be a positive number, got {value}", value=value, lower=0.0
                )
        if self.decimate is not None and self.decimate < 1:
            raise UsageError(f"decimate must be 1 or more, got {self.decimate}")
        if self.order < 1:
            raise UsageError(f"the order of the low-pass must be 1 or more, got {self.order}")
        for name, known in chosen.items():
            check_choice(name, getattr(self, name), known)

    @property
    def delays(self) -> tuple[float, ...]:
        """The delays that are known [s], one for all joints or each; empty if there are none."""
        if self.delay is None or isinstance(self.delay, str):
            return ()
        delays = self.delay if isinstance(self.delay, tuple) else (self.delay,)
        # A delay of 0 everywhere is none, so that such chains are equal.
        return delays if any(delays) else ()

    @classmethod
    def preset(cls, name: str) -> SignalChain:
        """Return a named chain: `default`, or `paper2015`.

        `paper2015` (Hayat, Abhishek and Saha, iNaCoMM 2015, section 4): positions through a
        second-order Butterworth at 7 Hz forwards and backwards, the double pass not corrected;
        velocity and acceleration by central differences; everything, torque included, decimated by
        10 with a Chebyshev type I filter of order 8; no parallel filter, no trimming, no delay.
        """
        presets = {
            "default": cls(),
            "paper2015": cls(
                cutoff=7.0,
                decimate=10,
                order=2,
                corrected=False,
                velocity="derived",
                parallel=False,
                trimmed=False,
                rests=True,
                delay=None,
            ),
        }
        if name not in presets:
            raise UsageError(f"there is no signal chain {name!r}; there are {', '.join(presets)}")
        return presets[name]
