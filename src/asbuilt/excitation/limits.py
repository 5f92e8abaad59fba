"""Limits of the joints, and the margins of a motion to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np

from asbuilt.arrays import Array, read_only
from asbuilt.description.model import Joint, RobotModel
from asbuilt.dynamics import TorqueModel, described_drive
from asbuilt.dynamics.kinematics import find_first_posture
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import JUMPING, QUANTITIES, Motion
from asbuilt.findings import Cure

TRIED = 100
"""Random postures, and postures along the range of a motor, at which loops must close."""


# Limits assumed if the description lacks them, revolute joints first, then prismatic ones.

ASSUMED_RANGE = (np.pi, 0.5)  # Position limit, +- [rad, m]; one turn, and a short linear axis
ASSUMED_VELOCITY = (1.5, 0.5)  # Velocity limit [rad/s, m/s]; slow for an arm
ASSUMED_RAMP = 0.4  # Time to reach the velocity limit [s], gives the acceleration limit
ASSUMED = {
    "position": ("lower", "upper"),
    "velocity": ("velocity",),
    "acceleration": ("acceleration",),
}
"""Quantities whose limits are assumed where the description lacks them, and the limits."""

_UNITS = {
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "acceleration": ("rad/s^2", "m/s^2"),
    "jerk": ("rad/s^3", "m/s^3"),
    "torque": ("N m", "N"),
}


@dataclass(frozen=True, eq=False)
class MotionBounds:
    """Limits of all joints as read-only arrays (n,), infinite if unknown.

    All but the position limits are symmetric.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, read_only(getattr(self, field.name)))

    @classmethod
    def of(cls, model: RobotModel) -> MotionBounds:
        """Return the limits that the description gives."""
        names = [field.name for field in fields(cls)]
        limits = [[getattr(joint.limits, name) for name in names] for joint in model.joints]
        return cls(*np.array(limits, dtype=np.float64).reshape(-1, len(names)).T)

    @classmethod
    def assumed(cls, model: RobotModel, fraction: float = 1.0) -> MotionBounds:
        """Return limits finite in position, velocity and acceleration, times `fraction`.

        Limits that the description lacks are +-pi rad or +-0.5 m, 1.5 rad/s or 0.5 m/s, and the
        velocity limit reached in 0.4 s. Position limits are reduced about their middle.
        """
        if not 0 < fraction <= 1:
            raise MotionError(
                f"the fraction of the limits must lie above 0 and at most at 1, got {fraction}"
            )
        given = cls.of(model)
        turns = np.array([joint.is_revolute for joint in model.joints])
        reach = np.where(turns, *ASSUMED_RANGE)
        lower = np.where(
            np.isfinite(given.lower),
            given.lower,
            np.where(np.isfinite(given.upper), given.upper - 2 * reach, -reach),
        )
        upper = np.where(
            np.isfinite(given.upper),
            given.upper,
            np.where(np.isfinite(given.lower), given.lower + 2 * reach, reach),
        )
        speed = np.where(turns, *ASSUMED_VELOCITY)
        velocity = np.where(np.isfinite(given.velocity), given.velocity, speed)
        acceleration = np.where(
            np.isfinite(given.acceleration), given.acceleration, velocity / ASSUMED_RAMP
        )
        middle = (lower + upper) / 2
        half = (upper - lower) / 2
        return replace(
            given,
            lower=middle - fraction * half,
            upper=middle + fraction * half,
            velocity=fraction * velocity,
            acceleration=fraction * acceleration,
            jerk=fraction * given.jerk,
            torque=fraction * given.torque,
        )


def complete_limits(model: RobotModel) -> tuple[RobotModel, tuple[str, ...]]:
    """Return the robot with complete limits, and the names of those that were assumed."""
    bounds = MotionBounds.assumed(model)
    names = [name for limits in ASSUMED.values() for name in limits]
    limits = [
        replace(joint.limits, **{name: float(getattr(bounds, name)[j]) for name in names})
        for j, joint in enumerate(model.joints)
    ]
    assumed = dict.fromkeys(
        quantity
        for joint in model.joints
        for quantity, needed in ASSUMED.items()
        if not all(np.isfinite(getattr(joint.limits, name)) for name in needed)
    )
    return model.with_limits(limits), tuple(assumed)


@dataclass(frozen=True, slots=True)
class LimitMargin:
    """Smallest margin of one joint to one limit.

    `margin = min(upper - x, x - lower) / ((upper - lower) / 2)`: 1 in the middle of the range, 0 at
    the limit, negative beyond it; `1 - |x| / limit` for symmetric limits.
    """

    quantity: str
    joint: str
    unit: str
    time: float
    value: float
    limit: float
    margin: float

    @property
    def violated(self) -> bool:
        """Whether the limit is exceeded, by more than rounding."""
        # A limit counts as violated when it is exceeded by more than this fraction (rounding).
        return self.margin < -1e-9

    def __str__(self) -> str:
        relation = (
            f"beyond its limit of {self.limit:.6g} {self.unit}"
            if self.violated
            else f"limit {self.limit:.6g} {self.unit}"
        )
        return (
            f"{self.quantity} of {self.joint} is {self.value:.6g} {self.unit} at t ="
            f" {self.time:.3f} s, {relation}, margin {self.margin:.1%}"
        )


@dataclass(frozen=True, slots=True, repr=False)
class LimitReport:
    """Smallest margin of every joint and quantity that has a finite limit."""

    margins: tuple[LimitMargin, ...]
    rate: float

    def __repr__(self) -> str:
        shares = {k: m and round(m, 4) for k, m in self.worst_margin.items()}
        return f"LimitReport(kept={self.is_respected}, worst_margin={shares})"

    @property
    def worst(self) -> dict[str, LimitMargin | None]:
        """Smallest margin over the joints by quantity, None without a limit."""
        return {
            quantity: min(
                (m for m in self.margins if m.quantity == quantity),
                key=lambda m: m.margin,
                default=None,
            )
            for quantity in _UNITS
        }

    @property
    def worst_margin(self) -> dict[str, float | None]:
        """Numbers of `worst`: fractions of the limit, negative if violated."""
        return {
            quantity: None if margin is None else margin.margin
            for quantity, margin in self.worst.items()
        }

    @property
    def violations(self) -> tuple[LimitMargin, ...]:
        """Every violated limit, the worst first."""
        return tuple(
            sorted(
                (margin for margin in self.margins if margin.violated),
                key=lambda margin: margin.margin,
            )
        )

    @property
    def is_respected(self) -> bool:
        """Whether every known limit is respected."""
        return not self.violations

    def raise_if_violated(self) -> None:
        """Raise MotionError naming joint, time, value, limit and a cure if a limit is violated."""
        violations = self.violations
        if not violations:
            return
        worst = violations[0]
        others = f" ({len(violations) - 1} more limits are violated)" if len(violations) > 1 else ""
        raise MotionError(
            f"{worst}; {_write_cure(violations)}{others}",
            joint=worst.joint,
            time=worst.time,
            value=worst.value,
            limit=worst.limit,
        )

    def __str__(self) -> str:
        lines = [str(margin) for margin in self.worst.values() if margin is not None]
        return "\n".join(lines) or "the description gives no limits"


def check_motion(model: RobotModel, motion: Motion, rate: float = 1000.0) -> LimitReport:
    """Compare a motion, sampled at `rate` [Hz] and at its end, with the limits of the robot.

    The torque is due to the rigid bodies and the drive terms with values in the description.
    Infinite limits are not reported, nor is the jerk of motions whose acceleration jumps.

    Raises
    ------
    MotionError
        If the motion has another number of joints than the robot.
    """
    if motion.n_joints != model.n_joints:
        raise MotionError(
            f"the motion moves {motion.n_joints} joints, {model.name} has {model.n_joints}:"
            f" {', '.join(model.joint_names)}"
        )
    t = motion.sample_times(rate)
    t = t if t[-1] >= motion.duration else np.append(t, motion.duration)
    bounds = MotionBounds.of(model)
    known = [
        quantity
        for quantity in QUANTITIES
        if quantity != "jerk" or motion.parametrisation not in JUMPING
    ]
    values = {quantity: motion.derivative(t, order) for order, quantity in enumerate(known)}
    if np.any(np.isfinite(bounds.torque)):
        state = (values["position"], values["velocity"], values["acceleration"])
        values["torque"] = TorqueModel(model, *described_drive(model))(*state)
    margins = [
        found
        for quantity, x in values.items()
        for joint, values_of_joint in zip(model.joints, x.T, strict=True)
        if (found := _find_margin(joint, quantity, t, values_of_joint)) is not None
    ]
    return LimitReport((*margins, *_find_passive_margins(model, t, values)), rate)


def _find_margin(joint: Joint, quantity: str, t: Array, x: Array) -> LimitMargin | None:
    """Return the smallest margin of a joint with values (N,) at times t, None without a limit."""
    limits = joint.limits
    high = limits.upper if quantity == "position" else getattr(limits, quantity)
    low = limits.lower if quantity == "position" else -high
    if not np.isfinite(low) and not np.isfinite(high):
        return None
    half = (high - low) / 2 if np.isfinite(high - low) else 1.0
    slack = np.minimum(high - x, x - low)
    k = int(np.argmin(slack))
    return LimitMargin(
        quantity=quantity,
        joint=joint.name,
        unit=_UNITS[quantity][0 if joint.is_revolute else 1],
        time=float(t[k]),
        value=float(x[k]),
        limit=float(high if high - x[k] <= x[k] - low else low),
        margin=float(slack[k] / half) if half > 0 else float(np.sign(slack[k])),
    )


def _find_passive_margins(
    model: RobotModel, t: Array, values: Mapping[str, Array]
) -> Iterator[LimitMargin]:
    """Yield margins of passive joints; raises MotionError where loops do not close."""
    if find_first_posture(model) is None:
        return
    try:
        moved = model.link_motion(*(values[name] for name in QUANTITIES[:3]))
    except MotionError as error:
        at = t[error.fields["sample"]]
        raise MotionError(
            f"at t = {at:.3f} s {error.message}", cure=error.cure, joint=error.joint, time=at
        ) from None
    for k, joint in enumerate(model.followers, start=model.n_joints):
        for quantity, x in zip(QUANTITIES, (moved.q, moved.qd, moved.qdd), strict=False):
            found = _find_margin(joint, quantity, t, x[:, k]) if joint.is_passive else None
            if found is not None:
                yield found


def make_open_error(model: RobotModel) -> MotionError:
    """Return what is wrong where no motion about the posture of the description exists."""
    return MotionError(
        f"{model.name}: no random motion was found along which the loops close; check points of"
        " the loops and the posture of the description"
    )


def refuse_open_postures(model: RobotModel) -> None:
    """Raise MotionError where the loops do not close everywhere within the limits of the motors.

    A search for a motion may go anywhere there. Corners of the limits are tried, and random
    postures; limits that the description lacks are the assumed ones.
    """
    home = find_first_posture(model)
    if home is None:
        return
    n = model.n_joints
    bounds = MotionBounds.assumed(model)
    low = bounds.lower
    high = bounds.upper
    corners = [np.where(ends, high, low) for ends in product((False, True), repeat=min(n, 7))]
    corners = corners if n <= 7 else []
    q = np.vstack([*corners, np.random.default_rng(0).uniform(low, high, (TRIED, n))])
    open_at = np.flatnonzero(~model.joint_map.exists(q))
    if not open_at.size:
        return
    reach: dict[str, str] = {}
    for j in range(n):
        line = np.tile(home, (TRIED, 1))
        line[:, j] = np.linspace(low[j], high[j], TRIED)
        closed = line[model.joint_map.exists(line), j]
        if len(closed) < TRIED:
            reach[model.joint_names[j]] = f"{closed.min():.4g} to {closed.max():.4g}"
    listed = ", ".join(f"{joint} {span}" for joint, span in reach.items())
    alone = f": alone, with the others at the first posture, {listed}" if reach else ""
    raise MotionError(
        f"{model.name}: the loops do not close everywhere within the limits of the motors"
        f" ({open_at.size} of {len(q)} postures), so that no motion can be searched there",
        cure=Cure(f"narrow the limits of position to where they close{alone}"),
        joint=next(iter(reach), model.joint_names[0]),
    )


def _write_cure(violations: tuple[LimitMargin, ...]) -> str:
    orders = {quantity: order for order, quantity in enumerate(QUANTITIES) if order > 0}
    needed = [
        abs(v.value / v.limit) ** (1 / orders[v.quantity])
        for v in violations
        if v.quantity in orders
    ]
    factor = np.ceil(100 * max(needed, default=0.0)) / 100
    exceeded = {violation.quantity for violation in violations}
    cures = (
        (needed, f"slow the motion down: motion.slowed({factor:g})"),
        ("position" in exceeded, "choose poses or amplitudes within the position limits"),
        ("torque" in exceeded, "move slower or choose poses with less gravity torque"),
    )
    return "; ".join(cure for holds, cure in cures if holds)
