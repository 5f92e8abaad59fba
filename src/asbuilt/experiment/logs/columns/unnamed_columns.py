"""Guess of what the columns of a log hold, from their values and the robot's gravity torques."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import combinations, pairwise, permutations
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.experiment.gravity_load import (
    CLEAR_LOAD,
    CLEARLY_BETTER,
    DEGREE,
    LARGEST_RADIANS,
    correlations,
    match_load,
)
from asbuilt.experiment.logs.columns.roles import parse_unit_scale, recognise
from asbuilt.experiment.logs.formats.log_format import LogTable

RADIANS_ARE_LESS = DEGREE**0.5
DEGREES_ARE_MORE = DEGREE**-0.5
"""Ratios of velocities to the slope of positions in degrees, and in radians, above which they are
degrees."""
STEPS = {"ns": 2e5, "us": 200.0, "ms": 0.2, "s": -np.inf}
"""Units of time, and the least median step in each: 0.2 s."""

RATES = (5.0, 5000.0)
"""Rates of logs [Hz]: what velocities give beyond is another unit of theirs."""
CLOCK_STEPS = (0.99, 0.5)
"""Share of the steps of a clock that are forward, and of one that does not lead the columns also
within this of the median step."""

EVEN_SORTED = 0.9
"""Share of even steps of a clock whose rows are out of order here and there."""
FOLLOWS = 0.8
"""Correlation with a derivative from which a group is one."""
MOST_QUANTITIES = 32
"""Quantities of each joint that are compared with each other, every pair: logs have a dozen."""

DRAFT = (
    "[columns]  # an example: the values decide nothing\n"
    'time = 1\nposition = "2-7"\ntorque = "8-13"'
)
"""What a sheet looks like, where nothing of it can be guessed."""


@dataclass(frozen=True, slots=True)
class SheetDraft:
    """Hold the fields of a sheet that values of columns decide.

    `fields` have no `columns` where nothing is decided, and a `rate` of None where one is lacking.
    `torques` are other columns that may be the torque, and `over` columns follow what was guessed.
    """

    fields: Mapping[str, Any]
    torques: Sequence[Any] = ()
    over: int = 0

    @property
    def decides(self) -> bool:
        """Whether the values decide what the columns hold."""
        return "columns" in self.fields

    @property
    def certain(self) -> dict[str, Any]:
        """What is certain of it; {} where nothing is decided."""
        known = {name: value for name, value in self.fields.items() if value is not None}
        return known if self.decides else {}

    @property
    def text(self) -> str:
        """The text of the sheet; an example of one where nothing is decided."""
        lines = ["header = false"] if "header" in self.fields else []
        rate = self.fields.get("rate")
        if not self.decides:
            return "\n".join([*lines, *([] if rate is None else [f"rate = {rate:g}"]), DRAFT])
        columns = self.fields["columns"]
        if "rate" in self.fields:
            end = "" if "time" in columns else "  # Hz"
            lines.append(f"rate = {100 if rate is None else rate:g}{end}")
        if "units" in self.fields:
            stated = ", ".join(f'{name} = "{unit}"' for name, unit in self.fields["units"].items())
            lines.append(f"units = {{ {stated} }}")
        also = f"  # or {', '.join(map(json.dumps, self.torques))}" if self.torques else ""
        lines.append("[columns]")
        for name, span in columns.items():
            lines.append(f"{name} = {json.dumps(span)}{also if name == 'torque' else ''}")
        if self.over:
            lines.append(f"# {self.over} more columns follow")
        return "\n".join(lines)


def suggest_sheet(
    table: LogTable, model: RobotModel | None = None, rate: float | None = None
) -> str:
    """Return a recording sheet for columns of unknown meaning, as far as their values decide it.

    The first column that increases, other than a counter of the rows, is time; a group that is
    another's derivative is its velocity; one that another follows closely is its command. With a
    robot, torque is the first group that correlates
    clearly with its gravity torques at the positions, which are degrees if that correlates better;
    without one, the first of the groups left over. `rate` is the sampling rate that was given [Hz].
    """
    return draft_sheet(table, model, rate).text


def draft_sheet(
    table: LogTable, model: RobotModel | None = None, rate: float | None = None
) -> SheetDraft:
    """Return the sheet that `suggest_sheet` writes."""
    values = list(table.columns.values())
    time, others = _find_time_column(values)
    rows = table.n_samples
    t = np.arange(rows) / (rate or 1.0) if time is None else values[time]
    if time is not None and np.any(np.diff(t) < 0):
        in_order = np.argsort(t, kind="stable")
        t = t[in_order]
        values = [column[in_order] for column in values]
    rest = [values[k] for k in others]
    n_joints = _count_joints_by_derivative(rest, t) if model is None else model.n_joints
    fields: dict[str, Any] = {} if table.named else {"header": False}
    if time is None or rate is not None:
        fields["rate"] = rate
    fits = n_joints and 2 * n_joints <= len(rest) <= MOST_QUANTITIES * n_joints
    if not n_joints or not fits or rows < 2:
        return SheetDraft(fields)
    # The sheet counts text columns too.
    order = table.order or tuple(table.columns)
    places = [order.index(name) + 1 for name in table.columns]
    begins = range(0, len(rest) - n_joints + 1, n_joints)
    members = [others[k : k + n_joints] for k in begins]
    groups = [np.column_stack(rest[k : k + n_joints]) for k in begins]
    spans = [_write_span([places[j] for j in group]) for group in members]
    units: dict[str, str] = {}
    if time is not None and (unit := _guess_time_unit(t)) != "s":
        units["time"] = unit
        t = t * (parse_unit_scale(unit) or 1.0)
    names = list(table.columns)
    torques_by_name = {
        i
        for i, group in enumerate(members)
        if table.named and all(_is_torque(names[j]) for j in group)
    }
    position, command, velocity, torques, degrees = _assign_roles(t, groups, model, torques_by_name)
    # Whole numbers are counts, of which the check finds the unit.
    if degrees and not _is_whole(groups[position]):
        units |= dict.fromkeys(["position"] if command is None else ["position", "command"], "deg")
    if velocity is not None:
        ratio = _measure_ratio(t, groups[position], groups[velocity])
        if time is None and rate is None:
            fields["rate"] = _estimate_rate(groups[position], groups[velocity], degrees)
            ratio /= fields["rate"] or 1.0
        if ratio > (RADIANS_ARE_LESS if degrees else DEGREES_ARE_MORE):
            units["velocity"] = "deg/s"
    if units:
        fields["units"] = units
    entries = {
        "time": None if time is None else places[time],
        "position": spans[position],
        "velocity": None if velocity is None else spans[velocity],
        "command": None if command is None else spans[command],
        "torque": spans[torques[0]] if torques else None,
    }
    fields["columns"] = {name: entry for name, entry in entries.items() if entry is not None}
    over = len(rest) - n_joints * len(groups)
    return SheetDraft(fields, [spans[k] for k in torques[1:]], over)


def _find_time_column(values: Sequence[Array]) -> tuple[int | None, list[int]]:
    """Return which column is time, and which are neither time nor what stands before it.

    Time leads and rises, but may be set back once or twice, or it rises in steps alike elsewhere,
    behind counters and marks; rows out of order are no matter, if time is even when it is sorted.
    """
    leads = next((k for k, value in enumerate(values) if not _counts_rows(value)), len(values))
    others = list(range(leads, len(values)))
    first = values[leads] if others else np.empty(0)
    finite = first[np.isfinite(first)]
    rises = finite.size > 1 and finite[-1] > finite[0]
    if rises and np.mean(np.diff(finite) >= 0) >= CLOCK_STEPS[0]:
        return leads, others[1:]
    for share in (CLOCK_STEPS[0], EVEN_SORTED):
        for k in others:
            if _is_even(values[k], share):
                behind = [other for other in others if other > k]
                marks = all(np.ptp(values[other]) == 0.0 for other in others if other < k)
                return k, behind if marks else [other for other in others if other != k]
    return None, others


def _is_even(values: Array, share: float) -> bool:
    """Return whether this share of the steps is alike, and of the sorted values' steps as well."""
    steps = np.diff(values)
    middle = float(np.median(steps)) if steps.size else 0.0
    if not middle > 0.0:
        return False
    of_sorted = np.diff(np.sort(values))
    return all(
        float(np.mean(np.abs(each - middle) <= CLOCK_STEPS[1] * middle)) >= share
        for each in (steps, of_sorted)
    )


def _counts_rows(values: Array) -> bool:
    return values.size > 2 and values[0] in (0.0, 1.0) and bool(np.all(np.diff(values) == 1.0))


def _write_span(places: Sequence[int]) -> Any:
    """Return numbers of columns as a sheet has them: 2, "2-4", or ["2-4", "6-7"] with gaps."""
    cuts = [0, *(k for k in range(1, len(places)) if places[k] != places[k - 1] + 1), len(places)]
    parts = [(places[begin], places[stop - 1]) for begin, stop in pairwise(cuts)]
    spans = [f"{first}-{last}" if first != last else first for first, last in parts]
    return spans[0] if len(spans) == 1 else spans


def _guess_time_unit(values: Array) -> str:
    """Return the unit of times in which their median step is a rate between 5 and 5000 Hz."""
    step = float(np.median(np.diff(values[np.isfinite(values)])))
    return next(unit for unit, least in STEPS.items() if step >= least)


def _measure_ratio(t: Array, q: Array, qd: Array) -> float:
    """Return the size of velocities relative to the slope of positions."""
    slope = np.gradient(q, t, axis=0)
    ok = np.isfinite(slope) & np.isfinite(qd)
    return float(np.sqrt(np.sum(qd[ok] ** 2) / max(float(np.sum(slope[ok] ** 2)), 1e-30)))


def _estimate_rate(q: Array, qd: Array, degrees: bool) -> float | None:
    """Return the rate [Hz] at which the steps of positions are the velocities; None if none can be.

    Velocities in degrees per second with positions in radians count as such.
    """
    steps = np.gradient(q, axis=0)
    ok = np.isfinite(steps) & np.isfinite(qd)
    per_step = float(np.sum(qd[ok] ** 2)) / max(float(np.sum(steps[ok] * qd[ok])), 1e-30)
    rates = [per_step] if degrees else [per_step, per_step / (180 / np.pi)]
    # Velocities beyond are rather degrees per second [rad/s].
    if _find_largest(qd) > 10.0:
        rates.reverse()
    low, high = RATES
    return next((float(f"{rate:.3g}") for rate in rates if low <= rate <= high), None)


def _is_torque(name: str) -> bool:
    role = recognise(name)
    return role is not None and role.quantity in ("torque", "current")


def _assign_roles(
    t: Array, groups: list[Array], model: RobotModel | None, torques: Set[int] = frozenset()
) -> tuple[int, int | None, int | None, list[int], bool]:
    """Return which groups are positions, commands, velocities and torques, the likeliest first.

    And whether the positions are degrees. A command is what one group alone follows closely, and
    later; it is none of the other groups. Those of `torques` are torques by their names.
    """
    motions = [k for k in range(len(groups)) if k not in torques]
    follows = _correlate_derivatives(t, groups)
    moving = _find_derivative_pair(follows, motions, motions)
    # Difference of two groups, relative to their spread, up to which one is the command of the
    # other.
    close = [
        pair
        for pair in combinations(motions, 2)
        if (moving is None or moving[0] in pair)
        and _measure_difference(*(groups[k] for k in pair)) < 0.3
    ]
    known: int | None = None
    command: int | None = None
    velocities = [] if moving is None else np.flatnonzero(follows[moving[0]] > FOLLOWS).tolist()
    if len(close) == 1:
        i, k = close[0]
        # With two velocities, measured and commanded, both positions have a derivative.
        if moving is not None and len(velocities) < 2:
            known = k if moving[0] == k else i
        else:
            known = i if _is_later(t, groups[i], groups[k]) else k
        command = k if known == i else i
    rest = [k for k in range(len(groups)) if k != command]
    free = [k for k in rest if k not in torques]
    pair = _find_derivative_pair(follows, free if known is None else [known], free)
    if pair is not None and command is not None and len(velocities) == 2:
        # Measured and commanded quantities stand in the same order.
        pair = (pair[0], velocities[int(pair[0] > command)])
        rest = [k for k in rest if k not in velocities or k == pair[1]]
    position, velocity = pair or ((free or rest)[0] if known is None else known, None)
    turned = bool(_find_largest(groups[position]) > LARGEST_RADIANS)
    others = [k for k in rest if k not in (position, velocity)]
    if not others and velocity is not None and command is None:
        # Friction makes a torque look like a velocity; a log without torque or command is useless.
        others = [velocity]
        velocity = None
    if model is None:
        return position, command, velocity, others, turned
    matches = [
        np.stack([match_load(model, groups[k], groups, scale) for k in rest])
        for scale in (1.0, DEGREE)
    ]
    for match in matches:
        match[range(len(rest)), rest] = 0.0
        if command is not None:
            match[:, command] = 0.0
    if velocity is None and known is None:
        best = np.max(matches, axis=(0, 2))
        position = max(free or rest, key=lambda k: best[rest.index(k)])
        others = [k for k in rest if k != position]
    plain, in_degrees = (match[rest.index(position)] for match in matches)
    degrees = _find_largest(groups[position]) > LARGEST_RADIANS or (
        in_degrees.max() > max(CLEAR_LOAD, plain.max() + CLEARLY_BETTER)
    )
    loads = in_degrees if degrees else plain
    if np.max(loads) > CLEAR_LOAD:
        # Share of the best correlation from which groups count alike, in the order of the file:
        # what was commanded correlates better than what was measured.
        others.sort(key=lambda k: loads[k] < 0.8 * np.max(loads))
    return position, command, velocity, others, bool(degrees)


def _is_whole(values: Array) -> bool:
    finite = values[np.isfinite(values)]
    return bool(np.all(finite == np.round(finite)))


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


def _find_largest(values: Array) -> float:
    """Return the largest finite magnitude, 0 if there is none."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))


def _correlate_derivatives(t: Array, groups: Sequence[Array]) -> Array:
    """Return how the derivative of each group (row) is followed by each other one, (K, K)."""
    found = np.zeros((len(groups), len(groups)))
    for i, k in permutations(range(len(groups)), 2):
        found[i, k] = _correlate_derivative(t, groups[i], groups[k])
    return np.nan_to_num(found)


def _find_derivative_pair(
    follows: Array, first: Sequence[int], second: Sequence[int]
) -> tuple[int, int] | None:
    """Return the groups of which the second follows the derivative of the first best, if any."""
    pairs = ((i, k) for i in first for k in second)
    best = max(pairs, key=lambda pair: follows[pair], default=None)
    return best if best is not None and follows[best] > FOLLOWS else None


def _correlate_derivative(t: Array, q: Array, qd: Array) -> float:
    """Return the median correlation of the columns of qd with the derivative of q."""
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.gradient(q, axis=0) / np.gradient(t)[:, None]
    return float(np.median(correlations(slope, qd)))


def _count_joints_by_derivative(values: list[Array], t: Array) -> int | None:
    """Return the number of joints that makes the second group the derivative of the first."""
    for n in range(2, len(values) // 2 + 1 if t.size > 1 else 0):
        first = np.column_stack(values[:n])
        second = np.column_stack(values[n : 2 * n])
        if len(values) % n == 0 and _correlate_derivative(t, first, second) > FOLLOWS:
            return n
    return None
