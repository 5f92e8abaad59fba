"""Families of motions that are linear in their coefficients, and their registry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import Motion
from asbuilt.registry import Registry

SAFE_FREQUENCY = 0.25
"""Highest frequency without limits [Hz]; arms follow it without vibrating."""
HARMONICS = (4, 16)
"""Fewest and most harmonics of a period; beyond, a search gains nothing."""
POINTS = (4, 49)
"""Fewest and most control points; beyond, a search gains nothing."""
POINTS_PER_WAVE = 3.2
"""Control points per wave of the useful frequency (2 is Nyquist's)."""


@dataclass(frozen=True)
class Parametrisation(ABC):
    """Map coefficients (n_basis, n_joints) linearly to a motion of `duration` seconds.

    A subclass names itself with `key` and what `size` counts with `size_name`, and registers
    itself: `PARAMETRISATIONS.register(key, class)`.

    Parameters
    ----------
    duration
        Duration of the motion [s].
    size
        Number of harmonics, control points, way points or poses.
    """

    duration: float
    size: int
    periods: int = 1
    """Repetitions within the duration; only a periodic family has several."""
    key: ClassVar[str]
    size_name: ClassVar[str]
    density: ClassVar[float] = 0.0
    """Points per control point of a B-spline of equal richness; 0: as few as the duration asks."""
    band_limited: ClassVar[bool] = False
    """Whether no frequency exceeds `1 / shortest_wave`."""

    @classmethod
    def usual_size(
        cls, duration: float, periods: int | None, bounds: MotionBounds | None = None
    ) -> tuple[int, int | None]:
        """Return size and periods that suit these limits, where the user asks for no size."""
        useful = SAFE_FREQUENCY if bounds is None else useful_frequency(bounds)
        least, most = POINTS
        wave = POINTS_PER_WAVE
        slow = max(least, round(wave * SAFE_FREQUENCY * duration) + 1)
        quick = min(round(cls.density * (most - 1)), round(cls.density * wave * useful * duration))
        return max(slow, quick + 1), periods

    @abstractmethod
    def basis(self, t: Array, order: int) -> Array:
        """Return this derivative of the basis functions at the times `t` (N,), (N, n_basis)."""

    @abstractmethod
    def motion(self, coefficients: Array) -> Motion:
        """Return the motion with these coefficients."""

    @property
    @abstractmethod
    def shortest_wave(self) -> float:
        """Shortest time, about, in which a motion of the family goes there and back [s]."""

    @property
    @abstractmethod
    def constant(self) -> Array:
        """Coefficients (n_basis,) of the constant 1."""

    @property
    def span(self) -> float:
        """Time after which the motion ends or repeats [s]."""
        return self.duration

    def random(self, rng: np.random.Generator, n_joints: int) -> Array:
        """Return random coefficients that move every joint about 0, at no particular scale."""
        return rng.normal(size=(self.constant.size, n_joints))


PARAMETRISATIONS: Registry[type[Parametrisation]] = Registry(
    "parametrisation", "asbuilt.excitation.motions", "asbuilt.motions"
)
"""Families of motions by key."""


def useful_frequency(bounds: MotionBounds) -> float:
    """Return a tenth of the median of acceleration limit over velocity limit [Hz].

    Below it a joint moves at its velocity limit most of the time.
    """
    return float(np.median(bounds.acceleration / bounds.velocity)) / 10
