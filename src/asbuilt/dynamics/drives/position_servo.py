"""Position servo: the law by which a commanded position becomes the torque of a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import store_as
from asbuilt.description.model import RobotModel
from asbuilt.errors import UsageError

LIMITS = ("torque_limit", "no_load_speed", "goal_acceleration", "goal_speed")
"""Fields that are infinite where there is no limit."""
PER_JOINT = ("kp", "kd", "deadband", "lead", *LIMITS)
"""Fields with one number per joint."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionServo:
    """Hold the gains of proportional-derivative position control, joint by joint.

    The torque on the link is `clip(kp D(goal(t - delay) - q) - kd qd, -limit, limit)`. The goal is
    the command, or what `derive_goal_path` makes of it if the servo limits the acceleration of its
    goal, and `lead` times its rate: a servo whose derivative gain acts on the control error,
    `kp e + kr de/dt - kv qd`, has the lead `kr / kp` and the damping `kd = kr + kv`.
    D(e) is `e - clip(e, -deadband, deadband)`. Under a limited voltage the limits fall with the
    speed, `-limit (1 + qd / no_load_speed)` and `limit (1 - qd / no_load_speed)`; a servo without
    damping of its own, whose duty cycle is `kp D(e) / limit`, has this law with
    `kd = limit / no_load_speed`, the damping by the voltage that its motor induces.

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
    deadband
        Control error up to which the servo gives no torque [rad or m], shape (n,); NaN where it is
        unknown whether there is one.
    lead
        Gain of the derivative of the control error over the stiffness [s], shape (n,).
    no_load_speed
        Speed at which the voltage that the motor induces leaves no torque [rad/s or m/s], shape
        (n,); infinite where the torque limit does not fall with the speed.
    goal_acceleration
        Largest acceleration of the goal [rad/s^2 or m/s^2], shape (n,); infinite where there is no
        limit, NaN where it is unknown whether there is one.
    goal_speed
        Largest speed of a goal with limited acceleration [rad/s or m/s], shape (n,); infinite where
        there is none.

    Raises
    ------
    UsageError
        If lengths differ, or a value is negative or, for the delay, not finite, or a limit of the
        goal or the no-load speed is zero, or the goal's speed is limited without an acceleration,
        or there is a no-load speed without a torque limit, or a lead is not finite.

    Examples
    --------
    >>> servo = PositionServo(kp=(20.0, 20.0), kd=(1.5, 1.5), torque_limit=(4.0, 23.7))
    >>> servo.torque([0.5, 0.5], [0.1, 0.1], [0.0, 1.0])
    array([4. , 6.5])
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    torque_limit: tuple[float, ...] = field(default=(), metadata=store_as(missing=np.inf))
    delay: float | None = None
    deadband: tuple[float, ...] = ()
    lead: tuple[float, ...] = ()
    no_load_speed: tuple[float, ...] = field(default=(), metadata=store_as(missing=np.inf))
    goal_acceleration: tuple[float, ...] = field(default=(), metadata=store_as(missing=np.inf))
    goal_speed: tuple[float, ...] = field(default=(), metadata=store_as(missing=np.inf))

    def __post_init__(self) -> None:
        for name in PER_JOINT:
            values = tuple(float(value) for value in getattr(self, name))
            if not values and name not in ("kp", "kd"):
                values = (np.inf if name in LIMITS else 0.0,) * len(self.kp)
            if len(values) != len(self.kp):
                raise UsageError(
                    f"{name} has {len(values)} values for {len(self.kp)} joints",
                    value=len(values),
                    expected=len(self.kp),
                )
            if any(value < 0.0 for value in values):
                raise UsageError(f"{name} must not be negative, got {min(values):g}", lower=0.0)
            if name.startswith("goal") and 0.0 in values:
                raise UsageError(f"{name} must be positive: the goal would never move", lower=0.0)
            if name == "no_load_speed" and 0.0 in values:
                raise UsageError("no_load_speed must be positive", lower=0.0)
            object.__setattr__(self, name, values)
        late = self.delay is not None and not np.isfinite(self.delay)
        problems = (
            (
                not np.all(np.isfinite(self.lead)),
                f"a lead must be a finite number of seconds, got {self.lead}",
            ),
            (
                np.any(np.isfinite(self.goal_speed) & np.isinf(self.goal_acceleration)),
                "a limit of the speed of the goal needs one of its acceleration",
            ),
            (
                np.any(np.isfinite(self.no_load_speed) & np.isinf(self.torque_limit)),
                "a no-load speed needs a torque limit, which falls to zero there",
            ),
            (late, f"the delay must be a finite number of seconds, got {self.delay}"),
        )
        for holds, problem in problems:
            if holds:
                raise UsageError(problem)

    @property
    def known(self) -> bool:
        """Whether every gain is known."""
        return bool(np.all(np.isfinite((*self.kp, *self.kd))))

    @property
    def limits_goal(self) -> bool:
        """Whether the goal of any joint differs from its command."""
        return bool(np.any(np.isfinite(self.goal_acceleration)))

    def goal(self, t: ArrayLike, command: ArrayLike) -> tuple[Array, Array]:
        """Return the goal that follows commands (K, n) at times (K,), by `derive_goal_path`."""
        from asbuilt.dynamics.drives.goal_profile import derive_goal_path  # noqa: PLC0415 - light start

        limit = np.asarray(self.goal_acceleration)
        return derive_goal_path(
            t, command, np.where(np.isnan(limit), np.inf, limit), self.goal_speed
        )

    @property
    def proportional(self) -> bool:
        """Whether the torque is linear in control error and velocity up to a constant limit."""
        return not bool(np.any(self._dead) or np.any(np.isfinite(self.no_load_speed)))

    @property
    def leads(self) -> Array:
        """Leads as an array (n,) [s]."""
        return np.asarray(self.lead, dtype=np.float64)

    @property
    def _dead(self) -> Array:
        """Deadbands (n,), zero where unknown."""
        return np.asarray(np.nan_to_num(self.deadband), dtype=np.float64)

    def completed(self, other: Self) -> Self:
        """Return the servo with gains and torque limits of another one where its own are open."""
        mine, theirs = (
            np.array([servo.kp, servo.kd, servo.torque_limit], dtype=np.float64)
            for servo in (self, other)
        )
        kp, kd, limit = np.where(np.isfinite(mine), mine, theirs).tolist()
        return replace(self, kp=tuple(kp), kd=tuple(kd), torque_limit=tuple(limit))

    def reordered(self, order: Sequence[int]) -> Self:
        """Return the servo of the joints at these positions."""
        own: dict[str, Any] = {
            name: tuple(getattr(self, name)[k] for k in order) for name in PER_JOINT
        }
        return replace(self, **own)

    def behind_base(self, n: int) -> Self:
        """Return the servo with `n` joints before its own that nothing drives."""
        own: dict[str, Any] = {
            name: ((np.inf if name in LIMITS else 0.0,) * n) + getattr(self, name)
            for name in PER_JOINT
        }
        return replace(self, **own)

    @property
    def falling(self) -> Array:
        """How much the torque limit falls per speed (n,) [N m s/rad or N s/m]."""
        ratio = [
            limit / speed if np.isfinite(speed) else 0.0
            for limit, speed in zip(self.torque_limit, self.no_load_speed, strict=True)
        ]
        return np.array(ratio)

    def acting(self, error: ArrayLike) -> Array:
        """Return the part of control errors (..., n) beyond the deadband [rad or m]."""
        error = np.asarray(error, dtype=np.float64)
        return np.asarray(error - np.clip(error, -self._dead, self._dead))

    def bounds(self, qd: ArrayLike) -> tuple[Array, Array]:
        """Return the lowest and the highest torque at velocities (..., n), two (..., n)."""
        limit = np.asarray(self.torque_limit)
        falls = self.falling * np.asarray(qd, dtype=np.float64)
        return -limit - falls, limit - falls

    def torque(self, command: ArrayLike, q: ArrayLike, qd: ArrayLike) -> Array:
        """Return the torque [N m or N] of a command that has arrived, shape (..., n)."""
        error = np.asarray(command, dtype=np.float64) - np.asarray(q, dtype=np.float64)
        free = np.asarray(self.kp) * self.acting(error) - np.asarray(self.kd) * np.asarray(qd)
        return np.asarray(np.clip(free, *self.bounds(qd)), dtype=np.float64)


def read_described_servo(model: RobotModel) -> PositionServo | None:
    """Return the position servo that a description states, NaN for joints without one.

    None if it states none. Such gains are often settings of a simulator.
    """
    # None becomes NaN
    gains = np.array([(joint.drive.kp, joint.drive.kd) for joint in model.joints], dtype=np.float64)
    kp, kd = map(tuple, gains.T.tolist())
    if not np.any(np.isfinite(kp)):
        return None
    limits = tuple(joint.limits.torque for joint in model.joints)
    return PositionServo(kp=kp, kd=kd, torque_limit=limits)
