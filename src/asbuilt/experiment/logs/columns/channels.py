"""Channels of one quantity: raw beside filtered, sensor beside motor, and which of them is used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.joint_matching import split_words
from asbuilt.description.model import RobotModel
from asbuilt.experiment.gravity_load import CLEAR_LOAD, match_load
from asbuilt.experiment.logs.columns.roles import Role, parse_unit_scale
from asbuilt.experiment.logs.sheet import RecordingSheet

SENSOR_WORDS = {"sensor", "sensors", "sm", "sns", "meas", "measured", "msr", "ft"}
MODEL_WORDS = {"model", "computed", "calc", "calculated", "dyn", "gravity", "ideal", "est", "hat"}
CURRENT_WORDS = {"cur", "curr", "current", "motor", "mot"}
SMOOTHED_WORDS = {"filtered", "filt", "lpf", "smooth", "smoothed"}
ALIKE = 0.8
"""Share of the best correlation with gravity from which channels count alike."""
SAME_SCALE = 0.2
"""Difference of the spreads of two channels, relative to one, up to which they share a unit."""
EXACT = 1e-9
"""Spread of a joint's torque relative to the largest, below which it was computed: no sensor is
that quiet."""


def split_channels(group: Sequence[Role]) -> dict[str, list[Role]]:
    """Return the columns of a quantity by what their names have besides joint and number.

    >>> roles = [Role("torque", "", k, column=f"{name}{k}") for name in "ab" for k in (1, 2)]
    >>> list(split_channels(roles))
    ['a*', 'b*']
    """
    channels: dict[str, list[Role]] = {}
    for role in group:
        channels.setdefault(_name_channel(role), []).append(role)
    return channels


def _name_channel(role: Role) -> str:
    """Return the name of a column with a star in place of its joint, or of its number."""
    if role.index is not None:
        before, _, after = role.column.rpartition(str(role.index))
        return f"{before}*{after}"
    return role.column.replace(role.joint, "*") if role.joint else role.column


def choose_channels(
    groups: dict[tuple[str, str], list[Role]],
    columns: Mapping[str, Array],
    model: RobotModel | None,
    sheet: RecordingSheet,
) -> list[str]:
    """Keep one channel of each quantity that has several, and return what was chosen."""
    notes = []
    count = None if model is None else model.n_joints + len(model.followers)
    listed = sheet.columns.by_group
    for key in sorted(groups, key=lambda key: key[0] != "position"):
        quantity, kind = key
        if quantity == "time" or kind == "sheet" or key in listed or not groups[key]:
            continue
        positions = groups.get(("position", ""), [])
        known = len(positions) if quantity != "position" and positions else count
        groups[key], note = _choose_channel(quantity, groups[key], known, columns, model, positions)
        notes += [note] if note else []
    return notes


def name_alike(chosen: Mapping[str, list[Role]], sheet: RecordingSheet) -> None:
    """Let columns that count joints count them alike, as `u_torque_1` beside `y_angle_1`.

    Where the names of a quantity are not the positions' joints, and both differ in their number
    alone, the number says the joint.
    """
    places = {role.index: role.joint for role in chosen["position"]}
    counted = None not in places and len(places) == len(chosen["position"])
    stems = {_strip_number(role.joint) for role in chosen["position"]}
    if not counted or len(stems) > 1 or isinstance(sheet.joints, list):
        return
    for quantity, group in chosen.items():
        own = {role.index for role in group}
        alone = {_strip_number(role.joint) for role in group}
        joints = {role.joint for role in group}
        if len(alone) == 1 and own == set(places) and joints != set(places.values()):
            chosen[quantity][:] = [replace(role, joint=places[role.index]) for role in group]


def _strip_number(joint: str) -> str:
    return joint.rstrip("0123456789")


def _choose_channel(
    quantity: str,
    group: Sequence[Role],
    n_joints: int | None,
    columns: Mapping[str, Array],
    model: RobotModel | None,
    positions: Sequence[Role],
) -> tuple[list[Role], str]:
    """Return the columns of the best channel, and a note; the group itself if it has only one.

    Of torques those that follow gravity, and of these a joint sensor's, then unnamed ones, then
    those from currents; ones that a model computed come last. Of others what is called nothing
    else, then what is called raw, in the same unit, then what was filtered.
    """
    channels = split_channels(group)
    places = [(role.joint, role.index) for role in group]
    several = len(set(places)) < len(places) or (n_joints is not None and len(group) > n_joints)
    size = n_joints or max(len(channel) for channel in channels.values())
    whole = {name: channel for name, channel in channels.items() if len(channel) == size}
    if not several or len(whole) < 2:
        return list(group), ""
    values = {name: _stack(channel, columns) for name, channel in whole.items()}
    loads = _match_gravity(model, positions, columns, values) if quantity == "torque" else {}
    best = max(loads.values(), default=0.0)
    scales = {name: _measure_spread(value) for name, value in values.items()}
    usual = float(np.median([*scales.values()]))

    def rank(name: str) -> tuple[bool, ...]:
        words = set(split_words(name))
        other_scale = abs(scales[name] - usual) > SAME_SCALE * usual
        return (
            best > CLEAR_LOAD and loads.get(name, best) < ALIKE * best,
            bool(words & MODEL_WORDS) or (quantity == "torque" and _is_computed(values[name])),
            not words & SENSOR_WORDS and any(set(split_words(n)) & SENSOR_WORDS for n in whole),
            bool(words & CURRENT_WORDS),
            "raw" in words and other_scale,
            bool(words & SMOOTHED_WORDS),
            "raw" in words,
        )

    chosen = min(whole, key=rank)
    others = ", ".join(name for name in channels if name != chosen)
    shared = f", correlation with gravity {loads[chosen]:.2f}" if chosen in loads else ""
    note = (
        f"the log has {len(whole)} channels of {quantity}: {chosen} was taken{shared}, and {others}"
        f" were not; choose another in a recording sheet: [columns] {quantity} = [...]"
    )
    return [replace(role, joint=_strip_channel(role, whole)) for role in whole[chosen]], note


def _strip_channel(role: Role, channels: Mapping[str, Sequence[Role]]) -> str:
    """Return the joint of a column of one channel, "" where its name is the channel's."""
    joints = {frozenset(each.joint for each in channel) for channel in channels.values()}
    return role.joint if len(joints) == 1 or role.index is None else ""


def _stack(channel: Sequence[Role], columns: Mapping[str, Array]) -> Array:
    ordered = sorted(channel, key=lambda role: role.index or 0)
    return np.column_stack([columns[role.column] for role in ordered])


def _match_gravity(
    model: RobotModel | None,
    positions: Sequence[Role],
    columns: Mapping[str, Array],
    values: Mapping[str, Array],
) -> dict[str, float]:
    """Return how each channel follows gravity's torque at the positions, in either unit of these.

    Empty where the order of the joints is not known, or there are no values.
    """
    fits = model is not None and len(positions) == model.n_joints
    rows = next(iter(values.values())).shape[0]
    if model is None or not fits or rows < 10 or any(role.index is None for role in positions):
        return {}
    q = _stack(positions, columns)
    named = positions[0].unit
    scales = [parse_unit_scale(named) or 1.0] if named else [1.0, np.pi / 180]
    found = [match_load(model, q, [*values.values()], scale) for scale in scales]
    return dict(zip(values, np.max(found, axis=0).tolist(), strict=True))


def _measure_spread(values: Array) -> float:
    """Return the standard deviation of what is finite, 0 of nothing."""
    known = values[np.isfinite(values)]
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.nan_to_num(np.std(known))) if known.size else 0.0


def _is_computed(values: Array) -> bool:
    """Return whether a joint's torque varies, and by less than any sensor's noise."""
    if not values.size:
        return False
    spread = np.array([_measure_spread(column) for column in values.T])
    return bool(np.any((spread > 0.0) & (spread < EXACT * np.max(spread))))
