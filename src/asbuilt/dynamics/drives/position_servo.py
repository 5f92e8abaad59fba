"""Position servo: the law by which a commanded position becomes the torque of a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import stored
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError


def _limits(values: Sequence[float | None]) -> tuple[float, ...]:
    """Return stored torque limits, infinite where None is stored."""
    return tuple(np.inf if each is None else float(each) for each in values)


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionServo:
    """Hold the gains of proportional-derivative position control, joint by joint.

    The torque on the link is `clip(kp (command(t - delay) - q) - kd qd, -limit, limit)`.

    Parameters
    ----------
    kp
        Stiffness [N m/rad or N/m], shape (n,); NaN where it is unknown.
    kd
        Damping [N m s/rad or N s/m], shape (n,); NaN where it is unknown.
    torque_limit
        Largest magnitude of the torque [N m or N], shape (n,); infinite where there is none.
    delay
        Time by which the torque follows the command [s]; None if unknown.

    Raises
    ------
    UsageError
        If lengths differ, or a value is negative or, for the delay, not finite.

    Examples
    --------
    >>> servo = PositionServo(kp=(20.0, 20.0), kd=(1.5, 1.5), torque_limit=(4.0, 23.7))
    >>> servo.torque([0.5, 0.5], [0.1, 0.1], [0.0, 1.0])
    array([4. , 6.5])
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    torque_limit: tuple[float, ...] = field(default=(), metadata=stored(decode=_limits))
    delay: float | None = None

    def __post_init__(self) -> None:
        for name in ("kp", "kd", "torque_limit"):
            values = tuple(float(value) for value in getattr(self, name))
            if name == "torque_limit" and not values:
                values = (np.inf,) * len(self.kp)
            if len(values) != len(self.kp):
                raise UsageError(
                    f"{name} has {len(values)} values for {len(self.kp)} joints",
                    value=len(values),
                    expected=len(self.kp),
                )
            if any(value < 0.0 for value in values):
                raise UsageError(f"{name} must not be negative, got {min(values):g}", lower=0.0)
            object.__setattr__(self, name, values)
        if self.delay is not None and not np.isfinite(self.delay):
            raise UsageError(f"the delay must be a finite number of seconds, got {self.delay}")

    @property
    def known(self) -> bool:
        """Whether every gain is known."""
        return bool(np.all(np.isfinite((*self.kp, *self.kd))))

    def reordered(self, order: Sequence[int]) -> Self:
        """Return the servo of the joints at these positions."""
        return replace(
            self,
            kp=tuple(self.kp[k] for k in order),
            kd=tuple(self.kd[k] for k in order),
            torque_limit=tuple(self.torque_limit[k] for k in order),
        )

    def torque(self, command: ArrayLike, q: ArrayLike, qd: ArrayLike) -> Array:
        """Return the torque [N m or N] of a command that has arrived, shape (..., n)."""
        error = np.asarray(command, dtype=np.float64) - np.asarray(q, dtype=np.float64)
        free = np.asarray(self.kp) * error - np.asarray(self.kd) * np.asarray(qd)
        limit = np.asarray(self.torque_limit)
        return np.asarray(np.clip(free, -limit, limit), dtype=np.float64)


def described_servo(model: RobotModel) -> PositionServo | None:
    """Return the position servo that a description states, NaN for joints without one.

    None if it states none. Such gains are often settings of a simulator.
    """
    kp, kd = (
        tuple(_known(getattr(joint.drive, name)) for joint in model.joints) for name in ("kp", "kd")
    )
    if not np.any(np.isfinite(kp)):
        return None
    limits = tuple(joint.limits.torque for joint in model.joints)
    return PositionServo(kp=kp, kd=kd, torque_limit=limits)


def _known(value: float | None) -> float:
    return np.nan if value is None else value
