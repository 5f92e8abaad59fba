"""What is wanted of a design."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asbuilt.errors import UsageError
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.parametrisations import PARAMETRISATIONS, Fourier, Parametrisation

LEAST_FREQUENCY = 0.25
"""Highest frequency of a Fourier series where nothing speaks for a higher one [Hz]."""

LEAST_HARMONICS, MOST_HARMONICS = 4, 16
"""Fewest and most harmonics in a period where none are asked for."""

LEAST_POINTS, MOST_POINTS, POINTS_PER_WAVE = 4, 49, 3.2
"""Fewest and most control points where none are asked for, and how many there are in a wave of the
useful frequency.
"""


@dataclass(frozen=True)
class DesignOptions:
    """Say what is wanted of a design.

    | field | meaning |
    |---|---|
    | `parametrisation`, `size` | family of motions and how rich it is: harmonics, control points or way points |
    | `duration`, `periods` | length of the motion [s]; a Fourier series may run through several periods, one where nothing else suits the limits |
    | `criterion`, `focus` | `d`, `a`, `e` or `condition`; names or ids of base parameters for D_s |
    | `noise` | standard deviation of the torque [N m or N], one number or one per joint |
    | `information_rate` | independent torque samples per second that the noise refers to [1/s] |
    | `fraction`, `torque_fraction` | how much of the limits of motion, and of torque, may be used |
    | `power` | greatest mechanical power of each joint [W], one number or one per joint; none where empty |
    | `perturbed`, `spread` | how many other robots the torque limit must hold for, and how far off their masses are |
    | `starts`, `seed`, `time_limit` | random starts of local searches, seed of everything random, and when the whole design is to be done [s] |
    """

    parametrisation: str = "fourier"
    size: int | None = None
    duration: float = 20.0
    periods: int | None = None
    criterion: str = "d"
    focus: tuple[str, ...] = ()
    noise: float | tuple[float, ...] = 1.0
    information_rate: float = 100.0
    fraction: float = 0.95
    torque_fraction: float = 0.8
    power: tuple[float, ...] = ()
    perturbed: int = 0
    spread: float = 0.1
    starts: int = 96
    seed: int = 0
    time_limit: float = 24.0

    def __post_init__(self) -> None:
        if self.parametrisation not in PARAMETRISATIONS:
            raise UsageError(
                f"unknown parametrisation {self.parametrisation!r}; available:"
                f" {', '.join(PARAMETRISATIONS)}"
            )
        for name in ("duration", "information_rate", "time_limit"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise UsageError(f"{name} must be a positive number, got {value}")
        for name in ("fraction", "torque_fraction"):
            if not 0 < getattr(self, name) <= 1:
                raise UsageError(
                    f"{name} must lie above 0 and at most at 1, got {getattr(self, name)}"
                )
        for name, count in (("starts", self.starts), ("periods", self.periods)):
            if count is not None and count < 1:
                raise UsageError(f"{name} must be at least 1, got {count}")
        if self.size is not None and self.size < 2:
            raise UsageError(
                "a design needs at least 2 harmonics, 3 way points or control points; got"
                f" {self.size}"
            )

    def for_limits(self, bounds: MotionBounds) -> DesignOptions:
        """Return the options with the harmonics and periods, control points or way points that suit
        a robot with these limits, where none are asked for.
        """
        if self.size is not None:
            return self
        useful = useful_frequency(bounds)
        if self.parametrisation != "fourier":
            return replace(self, size=usual_points(self.parametrisation, self.duration, useful))
        periods = self.periods or (
            max(1, round(useful * self.duration / MOST_HARMONICS))
            if useful > 1.01 * LEAST_FREQUENCY
            else 1
        )
        return replace(self, periods=periods, size=usual_harmonics(self.duration / periods, bounds))

    @property
    def family(self) -> Parametrisation:
        """The family of motions."""
        if self.parametrisation == "fourier":
            periods = self.periods or 1
            return Fourier(
                self.duration, self.size or usual_harmonics(self.duration / periods), periods
            )
        return PARAMETRISATIONS[self.parametrisation](
            self.duration, self.size or usual_points(self.parametrisation, self.duration)
        )


def usual_harmonics(period: float, bounds: MotionBounds | None = None) -> int:
    """Return the number of harmonics where none is asked for.

    At least 4, up to a quarter of a hertz or, for a robot that is quick, its useful frequency.

    Beyond 16 harmonics, a quarter of a hertz is all.
    """
    slow = max(LEAST_HARMONICS, round(LEAST_FREQUENCY * period))
    return (
        slow
        if bounds is None
        else max(slow, min(MOST_HARMONICS, round(useful_frequency(bounds) * period)))
    )


def usual_points(parametrisation: str, duration: float, useful: float = LEAST_FREQUENCY) -> int:
    """Return the number of control points, way points or poses where none is asked for.

    At least 4 and one every 1.25 s; up to 49 control points or 25 way points for a quick robot.

    `useful` is its useful frequency [Hz]. A way point brings a velocity and an acceleration of its
    own, so that half as many are as rich as control points. Poses are not thickened, for a
    controller stops at each.
    """
    slow = max(LEAST_POINTS, round(POINTS_PER_WAVE * LEAST_FREQUENCY * duration) + 1)
    density = {"bspline": 1.0, "quintic": 0.5}.get(parametrisation, 0.0)
    return max(
        slow,
        min(
            round(density * (MOST_POINTS - 1)), round(density * POINTS_PER_WAVE * useful * duration)
        )
        + 1,
    )


def useful_frequency(bounds: MotionBounds) -> float:
    """Return a tenth of a / v, the median over joints of the limits of acceleration over velocity
    [Hz]: below, a joint is at full speed most of the time.
    """
    return float(np.median(bounds.acceleration / bounds.velocity)) / 10
