"""Guess of what the columns of a log hold, from their values and the robot's gravity torques."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.gravity_load import (
    CLEAR_LOAD,
    CLEARLY_BETTER,
    DEGREE,
    LARGEST_RADIANS,
    correlations,
    load_matches,
)
from asbuilt.experiment.logs.columns.roles import parse_unit_scale

DEGREES_PER_RADIAN = 180 / np.pi
RADIANS_ARE_LESS = DEGREE**0.5
"""Ratio of velocities to the slope of positions in degrees, above which they are degrees too."""
STEPS = {"ns": 2e5, "us": 200.0, "ms": 0.2, "s": -np.inf}
"""Units of time, and the least median step in each: 0.2 s."""

RATES = (5.0, 5000.0)
"""Rates of logs [Hz]: what velocities give beyond is another unit of theirs."""
CLOCK_STEPS = (0.99, 0.5)
"""Share of the steps of a clock that are forward, and of one that does not lead the columns also
within this of the median step."""

MOST_QUANTITIES = 32
"""Quantities of each joint that are compared with each other, every pair: logs have a dozen."""

DRAFT = (
    "[columns]  # an example: the values decide nothing\n"
    'time = 1\nposition = "2-7"\ntorque = "8-13"'
)
"""What a sheet looks like, where nothing of it can be guessed."""


def suggest_sheet(
    columns: Mapping[str, Array],
    model: RobotModel | None = None,
    *,
    named: bool = False,
    rate: float | None = None,
    numbers: Sequence[int] | None = None,
) -> str:
    """Return a recording sheet for columns of unknown meaning, as far as their values decide it.

    The first column that increases, other than a counter of the rows, is time; a group that is
    another's derivative is its velocity; one that another follows closely is its command. With a
    robot, torque is the first group that correlates
    clearly with its gravity torques at the positions, which are degrees if that correlates better;
    without one, the first of the groups left over.

    Parameters
    ----------
    columns
        Values by name, in the order of the file, (N,) each.
    model
        The robot.
    named
        Whether the file has a header row.
    rate
        The sampling rate that was given [Hz].
    numbers
        The number of each column in the file, from 1; by default they count up.
    """
    values = list(columns.values())
    places = list(range(1, len(values) + 1)) if numbers is None else list(numbers)
    time, others = _find_time_column(values)
    rest = [values[k] for k in others]
    places_of_rest = [places[k] for k in others]
    clock = None if time is None else values[time]
    n_joints = _count_joints_by_derivative(rest, clock) if model is None else model.n_joints
    head = [] if named else ["header = false"]
    if rate is not None:
        head.append(f"rate = {rate:g}")
    if not n_joints or not 2 * n_joints <= len(rest) <= MOST_QUANTITIES * n_joints:
        return "\n".join([*head, DRAFT])
    groups = [
        np.column_stack(rest[k : k + n_joints])
        for k in range(0, len(rest) - n_joints + 1, n_joints)
    ]
    spans = [
        _format_span(places_of_rest[k : k + n_joints])
        for k in range(0, len(rest) - n_joints + 1, n_joints)
    ]
    units: dict[str, str] = {}
    if clock is not None and (unit := _guess_time_unit(clock)) != "s":
        units["time"], clock = unit, clock * (parse_unit_scale(unit) or 1.0)
    t = np.arange(values[0].size) / (rate or 1.0) if clock is None else clock
    pair = _find_position_and_command(t, groups)
    kept = [k for k in range(len(groups)) if pair is None or k != pair[1]]
    position, velocity, torques, degrees = _assign_roles(
        t, [groups[k] for k in kept], model, None if pair is None else kept.index(pair[0])
    )
    position, torques = kept[position], [kept[k] for k in torques]
    velocity = None if velocity is None else kept[velocity]
    if degrees:
        units |= dict.fromkeys(["position"] if pair is None else ["position", "command"], "deg")
    if clock is None and rate is None:
        found = (
            None
            if velocity is None
            else _estimate_rate(groups[position], groups[velocity], degrees)
        )
        t = t / (found or 1.0)
        head.append("rate = 100  # Hz" if found is None else f"rate = {found:g}  # Hz")
    if velocity is not None:
        units |= _guess_velocity_unit(t, groups[position], groups[velocity], degrees)
    if units:
        stated = ", ".join(f'{name} = "{unit}"' for name, unit in units.items())
        head.append(f"units = {{ {stated} }}")
    also = ", ".join(spans[k] for k in torques[1:])
    entries = {
        "time": None if time is None else places[time],
        "position": spans[position],
        "velocity": None if velocity is None else spans[velocity],
        "command": None if pair is None else spans[pair[1]],
        "torque": spans[torques[0]] + (f"  # or {also}" if also else "") if torques else None,
    }
    listed = [f"{name} = {value}" for name, value in entries.items() if value is not None]
    over = len(rest) - n_joints * len(groups)
    further = [f"# {over} more columns follow"] if over else []
    return "\n".join([*head, "[columns]", *listed, *further])


def _find_time_column(values: Sequence[Array]) -> tuple[int | None, list[int]]:
    """Return which column is time, and which are neither time nor counters that lead the others."""
    leads = next((k for k, each in enumerate(values) if not _counts_rows(each)), len(values))
    others = list(range(leads, len(values)))
    if others and _increases(values[leads]):
        return leads, others[1:]
    time = next((k for k in others if _ticks(values[k])), None)
    return time, [k for k in others if k != time]


def _counts_rows(values: Array) -> bool:
    return values.size > 2 and values[0] in (0.0, 1.0) and bool(np.all(np.diff(values) == 1.0))


def _format_span(places: Sequence[int]) -> str:
    """Return numbers of columns as a sheet has them: "2-4", or ["2-4", "6-7"] with gaps."""
    cuts = [0, *(k for k in range(1, len(places)) if places[k] != places[k - 1] + 1), len(places)]
    parts = [(places[begin], places[stop - 1]) for begin, stop in pairwise(cuts)]
    texts = [f'"{first}-{last}"' if first != last else str(first) for first, last in parts]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"


def _guess_time_unit(values: Array) -> str:
    """Return the unit of times in which their median step is a rate between 5 and 5000 Hz."""
    step = float(np.median(np.diff(values[np.isfinite(values)])))
    return next(unit for unit, least in STEPS.items() if step >= least)


def _guess_velocity_unit(t: Array, q: Array, qd: Array, degrees: bool) -> dict[str, str]:
    """Return the unit of velocities under its name where it is not the positions' unit in SI."""
    slope = np.gradient(q, t, axis=0)
    ok = np.isfinite(slope) & np.isfinite(qd)
    factor = float(np.sqrt(np.sum(qd[ok] ** 2) / max(float(np.sum(slope[ok] ** 2)), 1e-30)))
    in_degrees = factor > DEGREES_PER_RADIAN**0.5 if not degrees else factor > RADIANS_ARE_LESS
    return {"velocity": "deg/s"} if in_degrees else {}


def _find_position_and_command(t: Array, groups: list[Array]) -> tuple[int, int] | None:
    """Return two groups of which the first follows the second closely, and later.

    It is the group of which another is the derivative, if there is one. None if no group follows
    another, or several do, such as currents too.
    """
    moving = _find_derivative_pair(t, groups, None)
    # Difference of two groups, relative to their spread, up to which one is the command of the
    # other.
    found = [
        (i, k)
        for i, k in combinations(range(len(groups)), 2)
        if (moving is None or moving[0] in (i, k))
        and _measure_difference(groups[i], groups[k]) < 0.3
    ]
    if len(found) != 1:
        return None
    (i, k) = found[0]
    if moving is not None:
        return (i, k) if i == moving[0] else (k, i)
    return (i, k) if _is_later(t, groups[i], groups[k]) else (k, i)


def _measure_difference(one: Array, other: Array) -> float:
    """Return the RMS difference of groups relative to their spread, the median over joints."""
    ok = np.all(np.isfinite(one) & np.isfinite(other), axis=1)
    spread = np.std(other[ok], axis=0) if ok.any() else np.zeros(other.shape[1])
    moves = spread > 0.0
    if not moves.any() or np.array_equal(one[ok], other[ok]):
        return np.inf
    error = np.sqrt(np.mean((one - other)[ok] ** 2, axis=0))
    return float(np.median(error[moves] / spread[moves]))


def _is_later(t: Array, q: Array, u: Array) -> bool:
    """Whether q follows u: to first order `q = u - delay u'`, so that `u' (q - u)` is negative."""
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.gradient(0.5 * (q + u), axis=0) / np.gradient(t)[:, None]
    lags = np.nansum(np.where(np.isfinite(rate), rate * (q - u), np.nan), axis=0)
    spread = np.nanstd(u, axis=0)
    return float(np.sum(lags[spread > 0.0] / spread[spread > 0.0] ** 2)) < 0.0


def _assign_roles(
    t: Array, groups: list[Array], model: RobotModel | None, known: int | None
) -> tuple[int, int | None, list[int], bool]:
    """Return the groups of positions and velocities, and groups of torques, the likeliest first.

    And whether the positions are degrees. `known` is the group of positions, if that is known.
    """
    pair = _find_derivative_pair(t, groups, known)
    position, velocity = pair if pair is not None else (known or 0, None)
    if model is None:
        rest = [k for k in range(len(groups)) if k not in (position, velocity)]
        return position, velocity, rest, bool(_find_largest(groups[position]) > LARGEST_RADIANS)
    plain, turned = _load_matches(model, groups, 1.0), _load_matches(model, groups, DEGREE)
    if velocity is None and known is None:
        best = np.maximum(np.max(plain, axis=1), np.max(turned, axis=1))
        position = int(np.argmax(best))
    degrees = _find_largest(groups[position]) > LARGEST_RADIANS or (
        np.max(turned[position]) > CLEAR_LOAD
        and np.max(turned[position]) > np.max(plain[position]) + CLEARLY_BETTER
    )
    loads = (turned if degrees else plain)[position]
    rest = [k for k in range(len(groups)) if k not in (position, velocity)]
    if np.max(loads) > CLEAR_LOAD:
        # Share of the best correlation from which groups count alike, in the order of the file:
        # what was commanded correlates better than what was measured.
        rest.sort(key=lambda k: loads[k] < 0.8 * np.max(loads))
    return position, velocity, rest, bool(degrees)


def _find_largest(values: Array) -> float:
    """Return the largest finite magnitude, 0 if there is none."""
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size else 0.0


def _load_matches(model: RobotModel, groups: list[Array], scale: float) -> Array:
    """Return how each group (column) follows gravity's torques at each group (row) as positions."""
    matches = np.stack([load_matches(model, q, groups, scale) for q in groups])
    np.fill_diagonal(matches, 0.0)
    return matches


def _increases(values: Array) -> bool:
    """Return whether values rise as times do, which may be set back once or twice."""
    finite = values[np.isfinite(values)]
    forward = np.diff(finite) >= 0
    return finite.size > 1 and float(np.mean(forward)) >= CLOCK_STEPS[0] and finite[-1] > finite[0]


def _ticks(values: Array) -> bool:
    """Return whether values rise in steps alike, as only times do."""
    steps = np.diff(values)
    middle = float(np.median(steps)) if steps.size else 0.0
    even = np.abs(steps - middle) <= CLOCK_STEPS[1] * middle
    return middle > 0.0 and float(np.mean(even)) >= CLOCK_STEPS[0]


def _estimate_rate(q: Array, qd: Array, degrees: bool) -> float | None:
    """Return the rate [Hz] at which the steps of positions are the velocities; None if none can be.

    Velocities in degrees per second with positions in radians count as such.
    """
    steps = np.gradient(q, axis=0)
    ok = np.isfinite(steps) & np.isfinite(qd)
    per_step = float(np.sum(qd[ok] ** 2)) / max(float(np.sum(steps[ok] * qd[ok])), 1e-30)
    rates = [per_step] if degrees else [per_step, per_step / DEGREES_PER_RADIAN]
    # Velocities beyond are rather degrees per second [rad/s].
    if _find_largest(qd) > 10.0:
        rates.reverse()
    low, high = RATES
    return next((float(f"{rate:.3g}") for rate in rates if low <= rate <= high), None)


def _find_derivative_pair(
    t: Array, groups: list[Array], known: int | None
) -> tuple[int, int] | None:
    """Return the groups of which the second follows the derivative of the first, if any."""
    best, pair = 0.8, None
    for i, q in enumerate(groups):
        for k, qd in enumerate(groups):
            if i != k and known in (None, i) and (match := _correlate_derivative(t, q, qd)) > best:
                best, pair = match, (i, k)
    return pair


def _correlate_derivative(t: Array, q: Array, qd: Array) -> float:
    """Return the median correlation of the columns of qd with the derivative of q."""
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.gradient(q, axis=0) / np.gradient(t)[:, None]
    return float(np.median(correlations(slope, qd)))


def _count_joints_by_derivative(values: list[Array], t: Array | None) -> int | None:
    """Return the number of joints that makes the second group the derivative of the first."""
    clock = (
        t
        if t is not None
        else np.arange(values[0].size, dtype=np.float64)
        if values
        else np.zeros(0)
    )
    for n in range(2, len(values) // 2 + 1):
        if (
            len(values) % n == 0
            and _correlate_derivative(
                clock, np.column_stack(values[:n]), np.column_stack(values[n : 2 * n])
            )
            > 0.8
        ):
            return n
    return None
