"""Checks of logged velocities against the derivative of the positions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from asbuilt.arrays import Array
from asbuilt.experiment.quality.passes import FirstPass
from asbuilt.experiment.quality.reductions import SmoothedMotion, normalise_columns
from asbuilt.findings import Cure, Finding, join_names

LEAVE_OUT = Cure("leave the velocity columns out; velocities are then derived from positions")


SWAPPED = 0.9
OWN = 0.8
"""Least correlation of a swapped column with another joint's derivative, and largest with its own;
a flipped sign has the negative of the second."""
_OTHER_UNITS = (60.0 / (2.0 * np.pi), 1.0 / (2.0 * np.pi), 1e3, 1e-3)
"""Revolutions per minute and per second, and thousandths."""


def check_velocities(
    statistics: FirstPass, motion: SmoothedMotion, logged: Array
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
    # One assignment of all columns: pairs alone would miss a cycle.
    swapped = [
        (int(moving[a]), int(moving[b]))
        for a, b in zip(*linear_sum_assignment(-correlation), strict=True)
        # The own correlation must be poor as well: joints that move in step correlate with all.
        if a != b and correlation[a, b] > SWAPPED and correlation[a, a] < OWN
    ]
    if swapped:
        pairs = join_names(
            [f"the velocity of {names[a]} belongs to {names[b]}" for a, b in swapped]
        )
        yield Finding(
            "velocity_swapped",
            "error",
            f"velocity columns are in another order than position columns: {pairs}",
            Cure("name the columns in a recording sheet: [columns] velocity = [...]"),
            joint=names[swapped[0][0]],
        )
        return
    gain = np.sum(logged * slope, axis=0)[moving] / energy[moving]
    middle = float(np.median(gain))
    units = {
        180 / np.pi: "degrees per second",
        np.pi / 180: "radians per second while positions are degrees",
    }
    unit = next((u for f, u in units.items() if abs(middle / f - 1) < 0.2), None)
    if unit is not None:
        yield Finding(
            "velocity_units",
            "error",
            f"the logged velocities are {middle:.4g} times the derivative of the positions: they"
            f" look like {unit}",
            Cure(
                'write the unit in a recording sheet: units = { velocity = "deg/s" }',
                # Only degrees have a cure in the sheet; the other way positions are wrong.
                sheet={"units": {"velocity": "deg/s"}} if middle > 1.0 else {},
            ),
        )
        return
    rate = _find_right_rate(statistics, np.diag(correlation), gain)
    if rate is not None:
        yield Finding(
            "rate_wrong",
            "error",
            f"the logged velocities of all {moving.size} joints that move are {middle:.4g} times"
            f" the derivative of the positions: the rate is {rate:.4g} Hz, not"
            f" {statistics.rate:.4g} Hz",
            Cure(
                "give that rate, or correct the time stamps; leave the velocity columns out if the"
                " velocities are wrong instead",
                settings={"rate": rate},
            ),
        )
        return
    low = 0.7  # gains of a usable velocity; the lower also bounds its correlation
    high = 1.4
    for k, factor, match in zip(moving, gain, np.diag(correlation), strict=True):
        if match < -OWN:
            message = (
                f"the logged velocity of {names[k]} has the opposite sign of the derivative of its"
                f" position (correlation {match:.3f})"
            )
        elif not low < factor < high or match < low:
            message = (
                f"the logged velocity of {names[k]} is {factor:.3g} times the derivative of its"
                f" position (correlation {match:.3f})"
            )
        else:
            continue
        yield Finding("velocity_mismatch", "warning", message, LEAVE_OUT, joint=names[k])
    yield from _find_lag(statistics, motion, logged, moving.tolist())
    yield from _check_ends(statistics, motion, logged, moving.tolist())


def _find_right_rate(statistics: FirstPass, correlation: Array, gain: Array) -> float | None:
    """Return the rate [Hz] at which velocities are derivatives of positions, if there is one.

    Units of velocity other than the units of the positions are no reason to doubt the rate.
    """
    # The same factor at all joints to a twentieth: no accident of single ones.
    common = float(np.median(gain))
    apart = 0.05
    wrong = (
        gain.size > 1
        and common > 0.0
        and abs(common - 1.0) > 0.15
        and np.all(np.abs(gain / common - 1.0) < apart)
        and np.all(correlation >= 0.95)
        and not any(abs(common / unit - 1.0) < apart for unit in _OTHER_UNITS)
    )
    return float(f"{common * statistics.rate:.3g}") if wrong else None


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
