"""Units of positions and velocities, decided by positions, velocities and torques together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import gravity_torque, inverse_dynamics
from asbuilt.experiment.gravity_load import DEGREE, LARGEST_RADIANS
from asbuilt.experiment.quality.passes import FirstPass
from asbuilt.experiment.quality.reductions import SmoothedMotion
from asbuilt.experiment.recording import UNWRAPPED
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.tables import round_significant

COUNTS = (*(2**k for k in range(9, 21)), *(36 * 10**k for k in range(2, 5)))
"""Counts of a turn of encoders, and of whole parts of a degree."""
BETWEEN = tuple(2.0 ** (k / 16.0) for k in range(-8, 9) if k)
"""Factors on the counts of a turn that are tried beside those known: gears multiply them."""
EXPLAINS = 0.5
"""Share of the torques that gravity, inertia and friction must explain to decide the counts."""
CLEARLY_LESS = 0.7
"""Share of torques left without explanation, relative to other counts of a turn, that decides."""
MOST_ROWS = 800
"""Samples by which units are compared."""
ALIKE = 0.05
"""Difference of the velocities' factors of joints, relative to one, up to which they are one unit;
also of a factor and a known unit's."""
DEGREES_WITHIN = 0.2
"""Difference of a factor and a degree, relative to it, up to which `check_velocities` names it."""
WITHIN = 1.2
"""Positions, relative to the limits of a joint, up to which a unit is possible."""
FOLLOW = 0.95
"""Correlation of velocities with the derivative of the positions from which only units differ."""
USUAL_VELOCITIES = (1.0, DEGREE, math.pi / 30.0, 2.0 * math.pi)
"""Radians, degrees and turns a second, and turns a minute, in rad/s."""
COUNTED = 0.02
"""Difference of velocities and the derivative of counts, relative to one, up to which they agree:
usual counts of a turn differ by five times as much."""
KNOWN_VELOCITIES = {
    "rpm": math.pi / 30.0,
    "0.229 rpm": 0.229 * math.pi / 30.0,
    "0.111 rpm": 0.111 * math.pi / 30.0,
    "0.01 rpm": 0.01 * math.pi / 30.0,
    "turn/s": 2.0 * math.pi,
    "mrad/s": 1e-3,
    "22.9 rad/s": 22.9,
}
"""Units of velocities of motors, and what they are in rad/s; the last one is of motors that count
.229 rpm, converted as if they counted .01 rpm."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Say in what counts positions are: counts of a turn, 0 where unknown, and the one of zero.

    `about` are the counts of a turn that the torques show where they are none that is usual,
    `alike` usual ones that the torques do not tell apart.
    """

    turn: int
    zero: int
    largest: float
    joints: tuple[str, ...]
    about: float = 0.0
    alike: tuple[int, ...] = ()

    def finding(self) -> Finding:
        """Return the finding for a log whose positions are counts."""
        said = (
            f"the positions of {join_names(list(self.joints))} are whole numbers up to"
            f" {self.largest:.6g}: counts of an encoder"
        )
        if self.about:
            said += (
                f"; the torques agree with about {round_significant(self.about, 2)} of a turn at"
                " the joint, as gears make of an encoder's"
            )
        if len(self.alike) > 1:
            turns = " and ".join(map(str, self.alike))
            said += f"; the torques agree with {turns} of a turn alike"
        if not self.turn:
            return Finding(
                "position_counts",
                "error",
                said,
                Cure(
                    "write the counts of a turn, and the position [rad] at which the description"
                    ' has zero, in a recording sheet: units = { position = "1/4096 turn" },'
                    " zero = 3.1416"
                ),
            )
        # Counts of half a turn or none are usual as zero.
        zero = 2.0 * math.pi * self.zero / self.turn
        unit = f"1/{self.turn} turn"
        fields = f'units = {{ position = "{unit}" }}, zero = {zero:.6g}'
        return Finding(
            "position_counts",
            "error",
            f"{said}; the torques agree with positions in {unit} from {self.zero} on",
            Cure(
                f"write the unit in a recording sheet: {fields}",
                sheet={"units": {"position": unit}} | ({"zero": zero} if self.zero else {}),
            ),
        )


def find_counts(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion | None
) -> Counts | None:
    """Return the counts of an encoder that positions are in, None if they are none.

    The counts of a turn, and where zero is, are those with which gravity, inertia and friction
    explain the torques best, clearly better than with others.
    """
    low = statistics.position_range.low
    high = statistics.position_range.high
    q = statistics.first.q
    known = q[np.all(np.isfinite(q), axis=1)]
    largest = float(np.max(np.maximum(np.abs(low), np.abs(high)), initial=0.0))
    # Whole numbers within a turn could be radians by chance; beyond they are counts.
    whole = known.size > 0 and bool(np.all(known == np.round(known)))
    if not whole or largest <= LARGEST_RADIANS or not all(j.is_revolute for j in model.joints):
        return None
    names = tuple(model.joint_names)
    if motion is None:
        return Counts(0, 0, largest, names)
    candidates = [(turn, zero) for turn in COUNTS if turn > np.max(high) for zero in (0, turn // 2)]
    left = {
        (turn, zero): _measure_left_over(model, motion, 2.0 * np.pi / turn, zero)
        for turn, zero in candidates
    }
    ranked = sorted(left, key=lambda each: left[each])
    if not ranked or left[ranked[0]] > 1.0 - EXPLAINS:
        return Counts(0, 0, largest, names)
    best = ranked[0]
    alike = [each for each in ranked if left[best] > CLEARLY_LESS * left[each]]
    # Where positions start again a turn ends; velocities in a usual unit count it.
    ends = [each for each in alike if _is_near(each[0], _find_wrap(statistics))]
    timed = [each for each in alike if _agrees_with_velocities(motion, each[0])]
    told = ends or (timed if len({turn for turn, _ in timed}) == 1 else [])
    best = told[0] if told else best
    # Two counts that explain about as much leave the turn open.
    if len(alike) > 1 and not told:
        turns = tuple(dict.fromkeys(turn for turn, _ in alike))
        return Counts(0, 0, largest, names, alike=turns)
    others = {
        factor: _measure_left_over(model, motion, 2.0 * np.pi / (factor * best[0]), best[1])
        for factor in BETWEEN
    }
    nearest = min(others, key=lambda factor: others[factor])
    # So do counts that none of those known is near.
    if others[nearest] < CLEARLY_LESS * left[best]:
        return Counts(0, 0, largest, names, about=nearest * best[0])
    return Counts(best[0], best[1], largest, names)


def _find_wrap(statistics: FirstPass) -> float:
    """Return the count at which positions started again, 0 where they were not unwrapped."""
    for note in statistics.first.notes:
        if note.startswith(UNWRAPPED):
            return float(note.removeprefix(UNWRAPPED).split()[0])
    return 0.0


def _is_near(turn: int, wrap: float) -> bool:
    # Notes have six digits.
    return abs(turn - wrap) < 1e-5 * turn


def _agrees_with_velocities(motion: SmoothedMotion, turn: int) -> bool:
    """Return whether logged velocities in a usual unit are the derivative of these counts."""
    if motion.logged_qd is None:
        return False
    energy = np.sum(motion.logged_qd**2, axis=0)
    moves = (energy > 0.0) & (np.std(motion.qd, axis=0) > 0.0)
    if not moves.any():
        return False
    # Counts a second for each unit of velocity.
    gains = np.sum(motion.qd * motion.logged_qd, axis=0)[moves] / energy[moves]
    gain = float(np.median(gains))
    return any(
        abs(gain / (turn * unit / (2.0 * math.pi)) - 1.0) < COUNTED for unit in USUAL_VELOCITIES
    )


KNOWN_POSITIONS = {
    "turn": 2.0 * math.pi,
    "mrad": 1e-3,
    "0.1 deg": 0.1 * DEGREE,
    "0.01 deg": 0.01 * DEGREE,
    "0.001 deg": 0.001 * DEGREE,
}
"""Units of positions of motors beside degrees and counts, and what they are in rad."""


def find_position_unit(model: RobotModel, statistics: FirstPass, motion: SmoothedMotion) -> str:
    """Return the unit of positions that torques show, "" for rad, degrees and where none does.

    The unit is that with which gravity, inertia and friction explain the torques best, clearly
    better than radians, degrees and the others, and within the limits of the joints.
    """
    if "position" in statistics.first.stated or not all(j.is_revolute for j in model.joints):
        return ""
    extremes = statistics.position_range
    largest = np.maximum(np.abs(extremes.low), np.abs(extremes.high))
    limits = [max(abs(joint.limits.lower), abs(joint.limits.upper)) for joint in model.joints]
    left = {
        name: _measure_left_over(model, motion, scale)
        for name, scale in ({"rad": 1.0, "deg": DEGREE} | KNOWN_POSITIONS).items()
        if name in ("rad", "deg") or np.all(largest * scale < WITHIN * np.array(limits))
    }
    best, second = sorted(left, key=lambda name: left[name])[:2]
    clear = left[best] < min(1.0 - EXPLAINS, CLEARLY_LESS * left[second])
    return best if clear and best in KNOWN_POSITIONS else ""


def report_position_unit(unit: str) -> Finding:
    """Return the finding of positions that are in another unit than radians or degrees."""
    return Finding(
        "position_units",
        "error",
        f"the torques agree with positions in units of {unit}, and not with radians or degrees",
        Cure(
            f'write the unit in a recording sheet: units = {{ position = "{unit}" }}',
            sheet={"units": {"position": unit}},
        ),
    )


def _measure_left_over(
    model: RobotModel, motion: SmoothedMotion, scale: float, zero: float = 0.0
) -> float:
    """Return the share of the torques that the description and friction leave unexplained.

    Positions are `scale` (logged - `zero`). Gravity and inertia have one factor, which a gain of
    the torque is; in another unit of positions they have different ones.
    """
    rows = motion.thinned(MOST_ROWS)
    q = scale * (motion.q[rows] - zero)
    qd = scale * motion.qd[rows]
    torque = inverse_dynamics(model, q, qd, scale * motion.qdd[rows])
    left = []
    for k in range(model.n_joints):
        friction = [qd[:, k], np.sign(qd[:, k])]
        share = _fit_joint(motion.tau[rows, k], [torque[:, k], *friction])[1]
        left += [] if np.isnan(share) else [share]
    return float(np.mean(left)) if left else 1.0


def _fit_joint(tau: Array, columns: Sequence[Array]) -> tuple[Array, float]:
    """Return the factors of columns in a torque (N,), and the share left; NaN if one is constant.

    Both are centred, which takes out an offset.
    """
    measured = tau - float(np.mean(tau))
    centred = np.column_stack([column - np.mean(column) for column in columns])
    power = float(measured @ measured)
    if power == 0.0 or np.any(np.std(centred, axis=0) == 0.0):
        return np.zeros(len(columns)), np.nan
    factors = np.linalg.lstsq(centred, measured, rcond=None)[0]
    return factors, float(np.sum((measured - centred @ factors) ** 2)) / power


@dataclass(frozen=True, slots=True)
class _Parts:
    """Hold the factors of gravity and inertia in the torque of a joint."""

    load: float
    inertia: float


def _fit_parts(model: RobotModel, q: Array, qd: Array, qdd: Array, tau: Array) -> list[_Parts]:
    """Fit torques of the joints by gravity, inertia and friction, each with a factor of its own.

    `tau_k = a g_k(q) + b (M(q) qdd + c(q, qd))_k + v qd_k + s sign(qd_k) + o`: a gain of the torque
    is in all of them, and a unit of time in b alone. Joints without load or inertia have none.
    """
    load = gravity_torque(model, q)
    inertia = inverse_dynamics(model, q, qd, qdd) - load
    parts = []
    for k in range(model.n_joints):
        columns = [load[:, k], inertia[:, k], qd[:, k], np.sign(qd[:, k])]
        factors, left = _fit_joint(tau[:, k], columns)
        # A joint without load or without inertia cannot compare the two.
        if not np.isnan(left):
            parts.append(_Parts(float(factors[0]), float(factors[1])))
    return parts


def find_velocity_unit(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion, logged: Array
) -> Iterator[Finding]:
    """Find velocities that are the derivative of the positions in another unit.

    A factor that all joints share is a unit, or a clock that is wrong by it. A unit that is known
    is believed, as is one where the torques agree with the clock.
    """
    slope = motion.qd
    energy = np.sum(slope**2, axis=0)
    moving = np.flatnonzero((energy > 0.0) & (np.std(logged, axis=0) > 0.0))
    if moving.size < 1:
        return
    # Least-squares factor of logged velocities on the derivative.
    gains = np.sum(logged * slope, axis=0)[moving] / energy[moving]
    alike = [float(np.corrcoef(logged[:, k], slope[:, k])[0, 1]) for k in moving]
    middle = float(np.median(gains))
    one = middle > 0.0 and bool(np.all(np.abs(gains / middle - 1.0) < ALIKE))
    degrees = any(
        abs(middle / unit_factor - 1.0) < DEGREES_WITHIN for unit_factor in (DEGREE, 1.0 / DEGREE)
    )
    # Near 1 the unit is right; degrees are another check's.
    if not one or min(alike) < FOLLOW or abs(middle - 1.0) < 3.0 * ALIKE or degrees:
        return
    factor = 1.0 / middle
    named = [
        name
        for name, known_factor in KNOWN_VELOCITIES.items()
        if abs(factor / known_factor - 1.0) < ALIKE
    ]
    # Without a known unit the clock is as likely wrong: the torques decide.
    if not named and not _keeps_clock(model, motion, middle):
        return
    unit = named[0] if named else f"{factor:.4g} rad/s"
    more = "" if named else ", and the torques agree with the clock"
    if unit == "22.9 rad/s":
        more = ", as of motors that count 0.229 rpm, read as if they counted 0.01 rpm"
    yield Finding(
        "velocity_units",
        "error",
        f"the logged velocities of all {moving.size} joints that move are {middle:.4g} times the"
        f" derivative of the positions: their unit is {unit}{more}",
        Cure(
            f'write the unit in a recording sheet: units = {{ velocity = "{unit}" }}',
            sheet={"units": {"velocity": unit}},
        ),
    )


def _keeps_clock(model: RobotModel, motion: SmoothedMotion, factor: float) -> bool:
    """Return whether torques agree with the clock, rather than with one that is `factor` as fast.

    A clock that is wrong by a factor makes accelerations wrong by its square, and with them the
    part of the torque that inertia takes, beside gravity's.
    """
    rows = motion.thinned(MOST_ROWS)
    q, qd, qdd, tau = (x[rows] for x in (motion.q, motion.qd, motion.qdd, motion.tau))
    if not np.all(np.isfinite(q)) or np.max(np.abs(q)) > LARGEST_RADIANS:
        return False
    votes = [
        math.log(parts.inertia / parts.load)
        for parts in _fit_parts(model, q, qd, qdd, tau)
        if parts.load * parts.inertia > 0.0
    ]
    if not votes:
        return False
    ratio = float(np.median(votes))
    # Inertia is off by the square of the clock's factor; which hypothesis is nearer?
    return abs(ratio) < abs(ratio - 2.0 * math.log(factor))
