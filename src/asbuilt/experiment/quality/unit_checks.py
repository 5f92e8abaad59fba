"""Units of positions, decided by positions, velocities and torques together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import inverse_dynamics
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
WITHIN = 1.2
"""Positions, relative to the limits of a joint, up to which a unit is possible."""
USUAL_VELOCITIES = (1.0, DEGREE, math.pi / 30.0, 2.0 * math.pi)
"""Radians, degrees and turns a second, and turns a minute, in rad/s."""
COUNTED = 0.02
"""Difference of velocities and the derivative of counts, relative to one, up to which they agree:
usual counts of a turn differ by five times as much."""


def check_position_unit(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion | None
) -> Finding | None:
    """Return the finding of positions in counts of an encoder, or in a unit that torques show.

    None where they may be radians, metres or degrees. A unit is that with which gravity, inertia
    and friction explain the torques best, clearly better than with others.
    """
    if not all(joint.is_revolute for joint in model.joints):
        return None
    q = statistics.first.q
    known = q[np.all(np.isfinite(q), axis=1)]
    largest = float(np.nanmax(statistics.position_range.furthest, initial=0.0))
    # Whole numbers within a turn could be radians by chance; beyond they are counts.
    if known.size and largest > LARGEST_RADIANS and np.all(known == np.round(known)):
        return _check_counts(model, statistics, motion, largest)
    if motion is None or "position" in statistics.first.stated:
        return None
    unit = _find_position_unit(model, statistics, motion)
    if unit is None:
        return None
    return Finding(
        "position_units",
        "error",
        f"the torques agree with positions in units of {unit}, and not with radians or degrees",
        Cure(
            f'write the unit in a recording sheet: units = {{ position = "{unit}" }}',
            sheet={"units": {"position": unit}},
        ),
    )


def _check_counts(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion | None, largest: float
) -> Finding:
    """Return the finding of counts up to `largest`; with the turn and its zero if torques show."""
    counted = (
        f"the positions of {join_names(list(model.joint_names))} are whole numbers up to"
        f" {largest:.6g}: counts of an encoder"
    )
    if motion is None:
        return _report_unknown_turn(counted)
    highest = np.max(statistics.position_range.high)
    left = {
        (turn, zero): _measure_left_over(model, motion, 2.0 * np.pi / turn, zero)
        for turn in COUNTS
        if turn > highest
        for zero in (0, turn // 2)
    }
    ranked = sorted(left, key=lambda counts: left[counts])
    if not ranked or left[ranked[0]] > 1.0 - EXPLAINS:
        return _report_unknown_turn(counted)
    alike = [counts for counts in ranked if left[ranked[0]] > CLEARLY_LESS * left[counts]]
    # Where positions start again a turn ends; velocities in a usual unit count it.
    ends = [counts for counts in alike if _is_near(counts[0], _find_wrap(statistics))]
    timed = [counts for counts in alike if _agrees_with_velocities(motion, counts[0])]
    told = ends or (timed if len({turn for turn, _ in timed}) == 1 else [])
    # Two counts that explain about as much leave the turn open.
    if len(alike) > 1 and not told:
        turns = list(dict.fromkeys(str(turn) for turn, _ in alike))
        also = f"; the torques agree with {' and '.join(turns)} of a turn alike"
        return _report_unknown_turn(counted + (also if len(turns) > 1 else ""))
    best = (told or ranked)[0]
    turn, zero = best
    others = {
        factor: _measure_left_over(model, motion, 2.0 * np.pi / (factor * turn), zero)
        for factor in BETWEEN
    }
    nearest = min(others, key=lambda factor: others[factor])
    # So do counts that none of those known is near.
    if others[nearest] < CLEARLY_LESS * left[best]:
        return _report_unknown_turn(
            f"{counted}; the torques agree with about {round_significant(nearest * turn, 2)} of a"
            " turn at the joint, as gears make of an encoder's"
        )
    unit = f"1/{turn} turn"
    at_zero = 2.0 * math.pi * zero / turn
    return Finding(
        "position_counts",
        "error",
        f"{counted}; the torques agree with positions in {unit} from {zero} on",
        Cure(
            "write the unit in a recording sheet: units = { position ="
            f' "{unit}" }}, zero = {at_zero:.6g}',
            sheet={"units": {"position": unit}} | ({"zero": at_zero} if zero else {}),
        ),
    )


def _report_unknown_turn(counted: str) -> Finding:
    return Finding(
        "position_counts",
        "error",
        counted,
        Cure(
            "write the counts of a turn, and the position [rad] at which the description has zero,"
            ' in a recording sheet: units = { position = "1/4096 turn" }, zero = 3.1416'
        ),
    )


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


def _find_position_unit(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion
) -> str | None:
    """Return the unit that torques show, within the limits of the joints; None for rad and deg."""
    limits = [max(abs(joint.limits.lower), abs(joint.limits.upper)) for joint in model.joints]
    largest = statistics.position_range.furthest
    left = {
        name: _measure_left_over(model, motion, scale)
        for name, scale in ({"rad": 1.0, "deg": DEGREE} | KNOWN_POSITIONS).items()
        if name in ("rad", "deg") or np.all(largest * scale < WITHIN * np.array(limits))
    }
    best, second = sorted(left, key=lambda name: left[name])[:2]
    clear = left[best] < min(1.0 - EXPLAINS, CLEARLY_LESS * left[second])
    return best if clear and best in KNOWN_POSITIONS else None


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
        share = fit_joint(motion.tau[rows, k], [torque[:, k], *friction])[1]
        left += [] if np.isnan(share) else [share]
    return float(np.mean(left)) if left else 1.0


def fit_joint(tau: Array, columns: Sequence[Array]) -> tuple[Array, float]:
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
