"""Checks of logged velocities against the derivative of the positions."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import gravity_torque, inverse_dynamics
from asbuilt.experiment.gravity_load import DEGREE, LARGEST_RADIANS
from asbuilt.experiment.quality.passes import FirstPass
from asbuilt.experiment.quality.reductions import (
    SmoothedMotion,
    find_swapped_columns,
    normalise_columns,
)
from asbuilt.experiment.quality.unit_checks import MOST_ROWS, fit_joint
from asbuilt.findings import Cure, Finding, join_names

LEAVE_OUT = Cure("leave the velocity columns out; velocities are then derived from positions")


SWAPPED = 0.9
OWN = 0.8
"""Least correlation of a swapped column with another joint's derivative, and largest with its own;
a flipped sign has the negative of the second."""
ALIKE = 0.05
"""Difference of the velocities' factors of joints, relative to one, up to which they are one unit;
also of a factor and a known unit's."""
FOLLOW = 0.95
"""Correlation of velocities with the derivative of the positions from which only units differ."""
DEGREES_WITHIN = 0.2
"""Difference of a factor and a degree, relative to it, up to which it is one."""
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


def check_velocities(
    model: RobotModel, statistics: FirstPass, motion: SmoothedMotion, logged: Array
) -> Iterator[Finding]:
    """Find logged velocities that are zero, swapped, in another unit, wrong, late or disturbed."""
    names = statistics.first.joint_names
    slope = motion.qd
    energy = np.sum(slope**2, axis=0)
    # Range of positions [rad or m] up to which a joint is at rest, its velocity noise.
    # At rest the derivative is noise, and correlates with nothing.
    moves = np.ptp(motion.q, axis=0) > 5e-3
    moving = np.flatnonzero(moves & (energy > 0) & (np.std(logged, axis=0) > 0))
    if not moving.size:
        if np.all(logged == 0) and np.any(moves & (energy > 0)):
            yield Finding(
                "velocity_zero",
                "warning",
                f"the logged velocities are 0 in all {statistics.n_samples} samples while the"
                " joints move; they are not used",
                Cure("leave the velocity columns out"),
            )
        return
    correlation = normalise_columns(logged[:, moving]).T @ normalise_columns(slope[:, moving])
    swapped = [
        (names[moving[a]], names[moving[b]])
        for a, b in find_swapped_columns(correlation, SWAPPED, OWN)
    ]
    if swapped:
        pairs = join_names([f"the velocity of {a} belongs to {b}" for a, b in swapped])
        yield Finding(
            "velocity_swapped",
            "error",
            f"velocity columns are in another order than position columns: {pairs}",
            Cure("name the columns in a recording sheet: [columns] velocity = [...]"),
            joint=swapped[0][0],
        )
        return
    gain = np.sum(logged * slope, axis=0)[moving] / energy[moving]
    match = np.diag(correlation)
    # A wrong unit or clock makes every comparison after it wrong.
    of_all = _explain_factor_of_all(model, statistics, motion, gain, match)
    if of_all is not None:
        yield of_all
        return
    low = 0.7  # gains of a usable velocity; the lower also bounds its correlation
    high = 1.4
    for k, factor, follows in zip(moving, gain, match, strict=True):
        if follows < -OWN:
            message = (
                f"the logged velocity of {names[k]} has the opposite sign of the derivative of its"
                f" position (correlation {follows:.3f})"
            )
        elif not low < factor < high or follows < low:
            message = (
                f"the logged velocity of {names[k]} is {factor:.3g} times the derivative of its"
                f" position (correlation {follows:.3f})"
            )
        else:
            continue
        yield Finding("velocity_mismatch", "warning", message, LEAVE_OUT, joint=names[k])
    yield from _find_lag(statistics, motion, logged, moving.tolist())
    yield from _check_ends(statistics, motion, logged, moving.tolist())


def _explain_factor_of_all(
    model: RobotModel,
    statistics: FirstPass,
    motion: SmoothedMotion,
    gain: Array,
    correlation: Array,
) -> Finding | None:
    """Return why all velocities are one multiple of the derivative: their unit, or the rate.

    `gain` and `correlation` (m,) are of the joints that move. A unit that is known is believed, as
    is one where the torques agree with the clock; else the clock is wrong.
    """
    middle = float(np.median(gain))
    degrees = {
        1.0 / DEGREE: "degrees per second",
        DEGREE: "radians per second while positions are degrees",
    }
    for factor, looks in degrees.items():
        if abs(middle / factor - 1.0) < DEGREES_WITHIN:
            return Finding(
                "velocity_units",
                "error",
                f"the logged velocities are {middle:.4g} times the derivative of the positions:"
                f" they look like {looks}",
                Cure(
                    'write the unit in a recording sheet: units = { velocity = "deg/s" }',
                    # Only degrees have a cure in the sheet; the other way positions are wrong.
                    sheet={"units": {"velocity": "deg/s"}} if middle > 1.0 else {},
                ),
            )
    # The same factor at all joints is no accident of single ones; near 1 the unit is right.
    one = middle > 0.0 and np.all(np.abs(gain / middle - 1.0) < ALIKE)
    if not one or np.min(correlation) < FOLLOW or abs(middle - 1.0) < 3.0 * ALIKE:
        return None
    several = (
        f"the logged velocities of all {gain.size} joints that move are {middle:.4g} times the"
        " derivative of the positions"
    )
    known = [
        name for name, unit in KNOWN_VELOCITIES.items() if abs(1.0 / (middle * unit) - 1.0) < ALIKE
    ]
    if known or _keeps_clock(model, motion, middle):
        unit = known[0] if known else f"{1.0 / middle:.4g} rad/s"
        more = "" if known else ", and the torques agree with the clock"
        if unit == "22.9 rad/s":
            more = ", as of motors that count 0.229 rpm, read as if they counted 0.01 rpm"
        return Finding(
            "velocity_units",
            "error",
            f"{several}: their unit is {unit}{more}",
            Cure(
                f'write the unit in a recording sheet: units = {{ velocity = "{unit}" }}',
                sheet={"units": {"velocity": unit}},
            ),
        )
    # A thousandth is of positions in mrad or mm, and no clock's; one joint alone is no clock's.
    if gain.size == 1 or abs(1e3 * middle - 1.0) < ALIKE:
        return None
    rate = float(f"{middle * statistics.rate:.3g}")
    return Finding(
        "rate_wrong",
        "error",
        f"{several}: the rate is {rate:.4g} Hz, not {statistics.rate:.4g} Hz",
        Cure(
            "give that rate, or correct the time stamps; leave the velocity columns out if the"
            " velocities are wrong instead",
            settings={"rate": rate},
        ),
    )


def _keeps_clock(model: RobotModel, motion: SmoothedMotion, factor: float) -> bool:
    """Return whether torques agree with the clock, rather than with one that is `factor` as fast.

    The torque of a joint is fitted as `a g_k(q) + b (M(q) qdd + c(q, qd))_k + v qd_k + s sign(qd_k)
    + o`: a gain of the torque is in all of them, and a clock that is wrong by a factor changes b
    alone, by the square of it.
    """
    rows = motion.thinned(MOST_ROWS)
    q, qd, qdd, tau = (x[rows] for x in (motion.q, motion.qd, motion.qdd, motion.tau))
    if not np.all(np.isfinite(q)) or np.max(np.abs(q)) > LARGEST_RADIANS:
        return False
    load = gravity_torque(model, q)
    inertia = inverse_dynamics(model, q, qd, qdd) - load
    votes = []
    for k in range(model.n_joints):
        columns = [load[:, k], inertia[:, k], qd[:, k], np.sign(qd[:, k])]
        of_load, of_inertia, *_ = fit_joint(tau[:, k], columns)[0]
        # A joint without load or without inertia has no factor of it, and cannot compare the two.
        if of_load * of_inertia > 0.0:
            votes.append(math.log(of_inertia / of_load))
    if not votes:
        return False
    ratio = float(np.median(votes))
    return abs(ratio) < abs(ratio - 2.0 * math.log(factor))


def _find_lag(
    statistics: FirstPass, motion: SmoothedMotion, logged: Array, moving: list[int]
) -> Iterator[Finding]:
    lags = np.array([_find_best_shift(logged[:, k], motion.qd[:, k]) for k in moving]) / motion.rate
    # Repeated samples lengthen the true period.
    step = 1.0 / (statistics.rate * (statistics.repeats.n_changed / statistics.n_samples))
    middle = float(np.median(lags))
    # Lag from which it is reported, in sampling periods; none is found if one of them is not known.
    # NaN compares as false: one joint without a lag leaves all open.
    if abs(middle) > 0.3 * step:
        low, high = (f"{1e3 * size:.2g}" for size in np.sort(np.abs(lags))[[0, -1]])
        worst = moving[int(np.argmax(np.abs(lags)))]
        yield Finding(
            "velocity_lag",
            "info",
            f"the logged velocities {'lag behind' if middle > 0 else 'run ahead of'} the derivative"
            f" of the positions by {low if low == high else f'{low} to {high}'} ms, most in"
            f" {statistics.first.joint_names[worst]} (sampling period {1e3 * step:.3g} ms)",
            LEAVE_OUT,
            joint=statistics.first.joint_names[worst],
        )


def _find_best_shift(late: Array, early: Array) -> float:
    """Return by how many samples `late` follows `early`, refined by a parabola.

    NaN if no shift up to a fifth of the signal matches.
    """
    most = min(30, late.size // 5)
    if most < 1:
        return float("nan")
    # The same inner part for every shift.
    inner = slice(most, late.size - most)
    shifts = range(-most, most + 1)
    correlation = np.array(
        [np.corrcoef(late[inner], early[most - d : early.size - most - d])[0, 1] for d in shifts]
    )
    k = int(np.argmax(correlation))
    # A best shift at the edge of the search is none.
    if not 0 < k < correlation.size - 1 or correlation[k] < SWAPPED:
        return float("nan")
    before, at, after = correlation[k - 1 : k + 2]
    # Vertex of the parabola through the three best.
    return float(k - most + 0.5 * (before - after) / (before - 2 * at + after))


def _check_ends(
    statistics: FirstPass, motion: SmoothedMotion, logged: Array, moving: list[int]
) -> Iterator[Finding]:
    """Find ends at which velocities and positions differ, as after the transient of a filter."""
    end = 0.4  # duration of the ends that a filter may have disturbed [s]
    width = int(end * motion.rate)
    # Ends must be a small part of the log, so that the inside is a standard.
    if width < 1 or motion.n_samples < 10 * width:
        return
    error = np.abs(logged - motion.qd)
    inner = np.sqrt(np.mean(error[width:-width] ** 2, axis=0))
    spread = np.std(motion.qd, axis=0)
    disturbed: dict[str, tuple[int, float]] = {}
    for name, part in (("first", slice(0, width)), ("last", slice(-width, None))):
        worst = np.max(error[part], axis=0)
        # Much more than inside, and a share of the motion that matters.
        bad = [k for k in moving if worst[k] > max(8.0 * inner[k], 0.2 * spread[k])]
        # Most joints: a filter disturbs all of them.
        if len(bad) * 2 > len(moving):
            k = max(bad, key=lambda k: worst[k] / spread[k])
            disturbed[name] = k, float(worst[k])
    # One window cuts both ends, whichever finding is followed.
    start = "0.5" if "first" in disturbed else ""
    stop = f"{statistics.duration - 0.5:.4g}" if "last" in disturbed else ""
    for name, (k, size) in disturbed.items():
        yield Finding(
            "end_transient",
            "warning",
            f"in the {name} {end:g} s the logged velocity of {statistics.first.joint_names[k]}"
            f" differs from the derivative of its position by up to {size:.3g} rad/s,"
            f" elsewhere by {inner[k]:.2g} rad/s, as at the end of a filtered signal",
            Cure(f"cut the {name} half second", {"window": f"{start}:{stop}"}),
            joint=statistics.first.joint_names[k],
            time=statistics.clock.first if name == "first" else statistics.clock.last - end,
        )
