"""Layout of a log: which columns hold which quantity of which joint."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

from asbuilt.description.joint_matching import (
    find_unlabelled_joints,
    match_joints,
    split_words,
)
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.channels import choose_channels, name_alike
from asbuilt.experiment.logs.columns.roles import (
    GOALS,
    PARTS,
    Quantity,
    Role,
    find_nanoseconds,
    match_commanded_role,
    parse_unit_scale,
    recognise,
    recognise_by_unit,
    split_unit,
)
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.sheet import ColumnName, RecordingSheet
from asbuilt.experiment.recording import ENCODERS, TorqueSource
from asbuilt.findings import Cure

QUANTITIES = ("position", "velocity", "acceleration", "torque", "command")
"""Quantities of every joint; others are kept as extras."""
_SYMBOLS: Mapping[str, Quantity] = {
    "q": "position",
    "qd": "velocity",
    "dq": "velocity",
    "qdd": "acceleration",
    "ddq": "acceleration",
    "tau": "torque",
    "q_command": "command",
}
_TORQUES: Mapping[tuple[str, str], TorqueSource] = {
    ("torque", ""): "unknown",
    ("torque", "sensor"): "sensor",
    ("torque", "motor"): "motor",
    ("current", ""): "current",
    ("torque", "unscaled"): "unknown",
    ("current", "unscaled"): "current",
}
"""Groups of columns that may be the torque, the best first, and what measured them."""
_EXTRAS = {
    ("torque", "external"): "tau_ext",
    ("torque", "motor"): "tau_motor",
    ("torque", "sensor"): "tau_sensor",
    **{("position", side): name for side, name in ENCODERS.items()},
}
"""Names of groups of columns that are kept in addition."""


@dataclass(frozen=True)
class Layout:
    """Columns of each quantity in joint order, and the factor of each column to SI.

    `quantities` has position, torque or command, and velocity, acceleration, and extras such as
    `tau_ext` where the log has them. A joint without a torque column has "" in its place.
    `nanoseconds` is a column to add to the time, `offsets` are added to columns in SI. A layout is
    `by_values` where these decided which of several channels of a quantity it has.
    """

    time: str | None
    quantities: Mapping[str, tuple[str, ...]]
    scales: Mapping[str, float]
    joint_names: tuple[str, ...]
    torque_source: TorqueSource = "unknown"
    notes: tuple[str, ...] = ()
    nanoseconds: str | None = None
    offsets: Mapping[str, float] = field(default_factory=dict)
    by_values: bool = False

    @property
    def columns(self) -> list[str]:
        """Every column that is needed, each once."""
        names = [name for group in self.quantities.values() for name in group if name]
        times = [each for each in (self.time, self.nanoseconds) if each]
        return list(dict.fromkeys([*times, *names]))


_Group = list[Role]
"""Columns of one quantity, with the joints that their names give."""


def find_layout(
    table: LogTable,
    *,
    sheet: RecordingSheet,
    model: RobotModel | None = None,
    has_gains: bool = False,
) -> Layout:
    """Find the columns of each quantity from the sheet, what the format knows, and the usual names.

    `has_gains` says that gains are given in addition to the sheet's.

    Raises
    ------
    RecordingError
        If positions are missing, or both torques and commands, columns are missing or claim the
        same place, or they do not fit the robot's joints.
    """
    source = table.source
    names = tuple(table.columns)
    known = _find_own_columns(names, model, sheet)
    for name, (quantity, joint) in table.known.items():
        unit = split_unit(name, quantity)[1]
        known[name] = Role(
            quantity,  # type: ignore[arg-type]
            joint,
            scale=(unit and parse_unit_scale(unit)) or 1.0,
            unit=unit,
        )
    of_base = {find_column(table, *each) for each in sheet.columns.by_base.items()}
    joined = [name for name in names if name not in of_base and table.known.get(name) != ("", "")]
    groups = _group_columns(joined, known, sheet)
    for (quantity, kind), listed in sheet.columns.by_group.items():
        groups[quantity, kind] = _group_listed_columns(table, quantity, listed, sheet)
    groups = {key: group for key, group in groups.items() if group}
    chosen_channels = choose_channels(groups, table.columns, model, sheet)
    measured = next((key for key in _TORQUES if key in groups), None)
    position = groups.get(("position", ""))
    command = groups.get(("command", ""))
    torque = None if measured is None else groups[measured]
    if position is None or (torque is None and command is None):
        absent = " and ".join(
            what
            for what, group in (("joint positions", position), ("joint torques", torque or command))
            if group is None
        )
        raise RecordingError(
            f"{source} has no columns for {absent}. Its columns are: {_join_many(names)}",
            cure=Cure(
                "name them in a recording sheet next to the log: [columns] position ="
                ' ["..."], torque = ["..."]; usual names are q_1, position_1, <joint>_pos and'
                " tau_1, effort_1, <joint>_torque; commanded positions do too: command = [...]"
            ),
            file=source,
            available=list(names),
            absent=absent,
        )
    if torque is not None and not has_gains:
        _refuse_unscaled(source, torque, sheet, model)
    chosen = {"position": position} | ({} if torque is None else {"torque": torque})
    for (quantity, kind), group in groups.items():
        if not (group is position or group is torque) and quantity != "time" and kind != "unscaled":
            name = quantity if kind in ("", "sheet") else f"{quantity}_{kind}"
            chosen[_EXTRAS.get((quantity, kind), name)] = group
    notes = list(chosen_channels)
    if torque is None:
        notes += _leave_out_uncommanded(chosen, groups["command", ""])
    name_alike(chosen, sheet)
    labels = _sort_labels(source, "position", position, sheet)
    ordered: dict[str, tuple[str, ...]] = {"position": tuple(_list_columns(position))}
    for quantity in [each for each in chosen if each != "position"]:
        try:
            ordered[quantity] = _align_columns(source, quantity, chosen, labels, sheet)
        except RecordingError:
            needed = quantity == ("command" if torque is None else "torque")
            if needed or (quantity, "") in sheet.columns.by_group:
                raise
            notes.append(
                f"the {len(chosen[quantity])} columns of {quantity} do not match the {len(labels)}"
                " joints and were left out"
            )
    joint_names = tuple(labels)
    if model is not None:
        places, matched = _match_order(model, source, labels, position, sheet)
        notes.extend(matched)
        followed = {
            f"{symbol}_{joint.name}": (ordered[quantity][labels.index(joint.name)],)
            for joint in model.followers
            for quantity, symbol in (("position", "q"), ("torque", "tau"))
            if joint.name in labels and quantity in ordered
        }
        ordered = {name: tuple(columns[k] for k in places) for name, columns in ordered.items()}
        joint_names = model.joint_names
        ordered = ordered | followed
    time = _find_time_column(table, groups, sheet)
    timed = {} if time is None else {"time": [time]}
    scales = _choose_scales(chosen | timed, sheet, notes)
    own_time = time is not None and sheet.columns.time is None
    return Layout(
        time.column if time else None,
        ordered,
        scales,
        joint_names,
        "unknown" if measured is None else _TORQUES[measured],
        tuple(notes),
        find_nanoseconds(time.column, names) if time and own_time else None,
        by_values=bool(chosen_channels),
    )


def _leave_out_uncommanded(chosen: Mapping[str, _Group], command: _Group) -> list[str]:
    """Leave out joints that no command is logged for, such as a gripper's, and say so."""
    commanded = {role.joint for role in command}
    joints = [role.joint for role in chosen["position"]]
    if "" in commanded or not commanded < set(joints):
        return []
    for group in chosen.values():
        group[:] = [role for role in group if role.joint in commanded]
    listed = ", ".join(joint for joint in joints if joint not in commanded)
    return [f"joints without a command were left out: {listed}"]


def _refuse_unscaled(
    source: str, torque: _Group, sheet: RecordingSheet, model: RobotModel | None
) -> None:
    """Raise if the torques have a unit without a factor to N m, and no gains are given.

    The limits of the description are proposed as what percent are of; a check then compares them
    with the masses.
    """
    role = torque[0]
    if role.kind == "unscaled" and sheet.gains is None and sheet.units.torque is None:
        limits = [] if model is None else [joint.limits.torque for joint in model.joints]
        gains = [float(f"{PARTS[role.unit] * limit:.4g}") for limit in limits if role.unit in PARTS]
        stated = len(limits) == len(torque) and all(map(math.isfinite, limits))
        raise RecordingError(
            f"{source}: the {role.quantity} columns ({role.column}, ...) are in {role.unit},"
            " which does not say how many N m they are",
            cure=Cure(
                "give the torque per logged unit of each joint, such as a hundredth of its rated"
                " torque for percent",
                settings={"gain": None},
                sheet={"gains": gains} if gains and stated else {},
            ),
            file=source,
            value=role.unit,
        )


def _find_own_columns(
    names: Sequence[str], model: RobotModel | None, sheet: RecordingSheet
) -> dict[str, Role]:
    """Return the columns named exactly by a quantity's symbol and a joint of the robot.

    This holds for quantities that have such a column for every joint, so that no joint's name is
    mistaken for a word, as in `q_tau` of a joint called tau.
    """
    joints = () if model is None or sheet.joints is not None else model.joint_names
    return {
        f"{symbols}_{joint}": Role(quantity, joint)
        for symbols, quantity in _SYMBOLS.items()
        if all(f"{symbols}_{joint}" in names for joint in joints)
        for joint in joints
    }


def _group_columns(
    names: Sequence[str], known: Mapping[str, Role], sheet: RecordingSheet
) -> dict[tuple[str, str], _Group]:
    """Return the columns of each quantity and kind, by what is known of them or by their names.

    Quantities that no column names are found by their units, and commands that only a word such as
    setpoint names where each joint with a position has one.
    """
    renamed = sheet.joints if isinstance(sheet.joints, dict) else {}

    def group(recognise_one: Callable[[str], Role | None]) -> dict[tuple[str, str], _Group]:
        groups: dict[tuple[str, str], _Group] = {}
        for name in names:
            if (role := recognise_one(name)) is not None:
                role = replace(role, joint=renamed.get(role.joint, role.joint), column=name)
                groups.setdefault((role.quantity, role.kind), []).append(role)
        for each in groups.values():
            _count_by_index(each)
        return groups

    groups = group(lambda name: known.get(name) or recognise(name) or match_commanded_role(name))
    _use_two_encoders(groups)
    by_unit = group(recognise_by_unit)
    goals = group(partial(match_commanded_role, alone=GOALS))
    named = {quantity for quantity, _ in groups} | (
        {"time"} if len(by_unit.get(("time", ""), ())) > 1 else set()
    )
    followed = sorted(_locate_joints(groups.get(("position", ""), [])))
    goals = {key: goal for key, goal in goals.items() if sorted(_locate_joints(goal)) == followed}
    by_unit = {key: each for key, each in by_unit.items() if key[0] not in named}
    return {**by_unit, **goals, **groups}


def _use_two_encoders(groups: dict[tuple[str, str], _Group]) -> None:
    """Make positions of motors the positions, and link positions a second set.

    Only where the others are called link positions; a log with positions of motors alone has no
    others.
    """
    other = groups.get(("position", ""), [])
    if ("position", "motor") in groups and all(
        split_words(role.joint)[:1] == ["link"] for role in other
    ):
        groups["position", ""] = groups.pop(("position", "motor"))
        if other:
            groups["position", "link"] = [replace(role, joint="") for role in other]


def _count_by_index(group: _Group) -> None:
    """Take out what all names of a group share, if they differ in a number alone.

    So that `/controller/feedback/positions[0]` counts joints, and names none.
    """
    numbers = [role.index for role in group]
    counts = None not in numbers and len(set(numbers)) == len(numbers) > 1
    if counts and len({role.joint for role in group}) == 1:
        group[:] = [replace(role, joint="") for role in group]


def _list_columns(group: _Group) -> list[str]:
    return [role.column for role in group]


def _locate_joints(group: _Group) -> list[tuple[str, int]]:
    """Return which joint each column belongs to, by name or else by number."""
    return [(role.joint, -1 if role.joint else role.index or 0) for role in group]


def find_column(table: LogTable, what: str, column: ColumnName) -> str:
    """Return the column that a sheet gives by its name, or by its number in the file."""
    source = table.source
    names = tuple(table.columns)
    counted = table.order or names
    given = f"{source}: the sheet gives column {column!r}"
    if isinstance(column, int) and not 1 <= column <= len(counted):
        raise RecordingError(
            f"{given} for {what}, but columns run from 1 to {len(counted)}",
            file=source,
            value=column,
            lower=1,
            upper=len(counted),
        )
    name = counted[column - 1] if isinstance(column, int) else column
    if name in names:
        return name
    if isinstance(column, int):
        raise RecordingError(
            f"{given} ({name!r}) for {what}, which holds text in place of numbers",
            cure=Cure("count the columns of the file from 1, text columns too"),
            file=source,
            value=column,
        )
    raise RecordingError(
        f"{given} for {what}, which the log does not have; it has {_join_many(names)}",
        file=source,
        value=column,
        available=list(names),
    )


def _join_many(names: Sequence[str]) -> str:
    return ", ".join(names[:40]) + (", ..." if len(names) > 40 else "")


def _group_listed_columns(
    table: LogTable, what: str, columns: Sequence[ColumnName], sheet: RecordingSheet
) -> _Group:
    """Return the columns that a sheet lists for a quantity."""
    source = table.source
    found = [find_column(table, what, column) for column in columns]
    repeated = next((name for name in found if found.count(name) > 1), None)
    if repeated is not None:
        raise RecordingError(
            f"{source}: the sheet gives column {repeated!r} twice for {what}",
            file=source,
            value=repeated,
        )
    labels = sheet.joints if isinstance(sheet.joints, list) and sheet.joints else [""] * len(found)
    if len(labels) != len(found):
        raise RecordingError(
            f"{source}: the sheet names {len(labels)} joints but gives {len(found)} columns for"
            f" {what}",
            file=source,
            value=len(found),
            expected=len(labels),
        )
    quantity = what if what in QUANTITIES else "torque"
    return [
        Role(quantity, label, k, column=name)  # type: ignore[arg-type]
        for k, (label, name) in enumerate(zip(labels, found, strict=True), start=1)
    ]


def _sort_labels(source: str, quantity: str, group: _Group, sheet: RecordingSheet) -> list[str]:
    """Sort a group by joint number if it only counts, and return its joint labels.

    If some columns name a joint, numbers are the names of the rest. Raises `RecordingError` if two
    columns are one joint's, a number is missing, or the sheet lists other joints.
    """
    places = [(role.joint, None if role.joint else role.index) for role in group]
    second = next((k for k, place in enumerate(places) if place in places[:k]), None)
    if second is not None:
        pair = [group[places.index(places[second])].column, group[second].column]
        raise RecordingError(
            f"{source}: columns {pair[0]!r} and {pair[1]!r} both look like the {quantity} of the"
            " same joint",
            cure=Cure(f"choose in a recording sheet: [columns] {quantity} = [...]"),
            file=source,
            value=pair,
        )
    listed = sheet.joints if isinstance(sheet.joints, list) else None
    if listed is None and any(role.joint for role in group):
        group[:] = [
            role if role.joint or role.index is None else replace(role, joint=f"joint_{role.index}")
            for role in group
        ]
    if all(role.joint for role in group):
        labels = [role.joint for role in group]
        if listed is not None and sorted(map(split_words, labels)) != sorted(
            map(split_words, listed)
        ):
            raise RecordingError(
                f"{source}: the sheet lists the joints {', '.join(listed)}, but the {quantity}"
                f" columns name theirs, {', '.join(labels)}",
                cure=Cure(
                    "give the robot's name of each joint of the log in its place: [joints] with"
                    f' "{labels[0]}" = "..." and so on'
                ),
                file=source,
                value=listed,
                expected=labels,
            )
        return labels
    group.sort(key=lambda role: (role.index is not None, role.index or 0))
    numbers = [role.index for role in group if role.index is not None]
    whole = range(int(0 not in numbers), max(numbers) + 1) if len(numbers) == len(group) else ()
    missing = next((k for k in whole if k not in numbers), None)
    if missing is not None:
        columns = _list_columns(group)
        raise RecordingError(
            f"{source}: the {quantity} column of joint number {missing} is missing; there are"
            f" {', '.join(columns)}",
            cure=Cure(
                f"add it, or choose columns in a recording sheet: [columns] {quantity} = [...]"
            ),
            file=source,
            available=columns,
        )
    if listed is not None and len(listed) != len(group):
        raise RecordingError(
            f"{source}: the sheet names {len(listed)} joints but the log has {len(group)}"
            f" {quantity} columns",
            file=source,
            value=len(group),
            expected=len(listed),
        )
    return listed or [f"joint_{k}" for k in range(1, len(group) + 1)]


def _align_columns(
    source: str,
    quantity: str,
    chosen: Mapping[str, _Group],
    labels: Sequence[str],
    sheet: RecordingSheet,
) -> tuple[str, ...]:
    """Return the columns of a quantity in the order of the position columns.

    Torques may lack joints, which have "" in their place, if names or numbers say which. One extra
    column of a sheet counts for all joints.
    """
    group = chosen[quantity]
    if quantity in sheet.columns.extra and len(group) == 1:
        return (group[0].column,) * len(labels)
    places = _locate_joints(chosen["position"])
    located = dict(zip(_locate_joints(group), _list_columns(group), strict=True))
    some = len(located) == len(group) and set(located) < set(places)
    if some and quantity == "torque" and sheet.columns.torque is None:
        return tuple(located.get(place, "") for place in places)
    own = _sort_labels(source, quantity, group, sheet)
    columns = _list_columns(group)
    if len(own) != len(labels):
        raise RecordingError(
            f"{source}: {len(labels)} position columns but {len(own)} {quantity} columns"
            f" ({', '.join(columns)}); each joint needs one of each",
            cure=Cure(f"choose columns in a recording sheet: [columns] {quantity} = [...]"),
            file=source,
            value=len(own),
            expected=len(labels),
        )
    if not all(role.joint for role in group):
        return tuple(columns)
    counted = all(label.startswith("joint_") for label in labels)
    with suppress(RecordingError):
        order, assumed = match_joints(own, labels, source=source, robot=source)
        if not assumed or counted:
            return tuple(columns[k] for k in order)
    raise RecordingError(
        f"{source}: joints of the {quantity} columns ({', '.join(own)}) are not the joints of the"
        f" position columns ({', '.join(labels)})",
        file=source,
        value=list(own),
        expected=list(labels),
    )


def _match_order(
    model: RobotModel, source: str, labels: Sequence[str], position: _Group, sheet: RecordingSheet
) -> tuple[list[int], tuple[str, ...]]:
    """Return the place of each joint of the robot among the labels, and notes."""
    named = sheet.joints is not None or all(role.joint for role in position)
    following = [joint.name for joint in model.followers]
    if named and len(labels) > 1:
        own = [k for k, label in enumerate(labels) if label not in following]
        order, notes = match_joints(
            [labels[k] for k in own], model.joint_names, source=source, robot=model.name
        )
        return [own[k] for k in order], notes
    if len(labels) != model.n_joints:
        missing = find_unlabelled_joints(labels, model.joint_names) if named else None
        beyond = ", ".join(model.joint_names[len(labels) :])
        more = f"; joints that the log lacks can be locked: {beyond}" if beyond else ""
        if following:
            more += f"; joints that follow others have no column: {', '.join(following)}"
        raise RecordingError(
            f"{source} has {len(labels)} position columns ({position[0].column} ..."
            f" {position[-1].column}) but {model.name} has {model.n_joints} joints"
            f" ({', '.join(model.joint_names)})",
            cure=Cure(
                "choose the robot that was recorded, or give the columns of its joints in a"
                f" recording sheet{more}"
            ),
            file=source,
            value=len(labels),
            expected=model.n_joints,
            missing=missing or _find_gripper_joints(model, len(labels)),
        )
    return list(range(len(labels))), ()


def _find_gripper_joints(model: RobotModel, count: int) -> tuple[str, ...] | None:
    """Return the joints behind the first `count` if those are an arm and these its gripper.

    The arm is a chain of joints in order. The others hang on its last link, and are no continuation
    of it: several hang on one link, or all slide.
    """
    parents = model.parents
    rest = model.joints[count:]
    chain = 0 < count < model.n_joints and parents[:count] == (ROOT, *range(count - 1))
    on = [joint.parent for joint in (*rest, *model.followers)]
    behind = all(parent >= count - 1 for parent in on)
    slides = len(set(on)) < len(on) or not any(joint.is_revolute for joint in rest)
    return tuple(joint.name for joint in rest) if chain and behind and slides else None


def _choose_scales(
    chosen: Mapping[str, _Group], sheet: RecordingSheet, notes: list[str]
) -> dict[str, float]:
    """Return the factor of each column to SI, and note what names of columns gave."""
    scales: dict[str, float] = {}
    named = {role.unit for role in chosen["position"]}
    for quantity, group in chosen.items():
        unit = getattr(sheet.units, quantity, None)
        unnamed = not any(role.unit for role in group)
        if unit is None and (quantity in ENCODERS.values() or (quantity == "command" and unnamed)):
            unit = sheet.units.position
            if unit is None and unnamed and len(named) == 1 and named != {""}:
                unit = next(iter(named))
                notes.append(f"{quantity} columns name no unit and have the positions', {unit}")
        for role in group:
            scales[role.column] = role.scale if unit is None else parse_unit_scale(unit) or 1.0
        units = {role.unit for role in group if role.scale != 1.0}
        if unit is None and units and quantity != "time":
            notes.append(f"{quantity} columns were converted from {', '.join(sorted(units))}")
    return scales


def _find_time_column(
    table: LogTable, groups: Mapping[tuple[str, str], _Group], sheet: RecordingSheet
) -> Role | None:
    """Return the column of the time, if there is one."""
    names = tuple(table.columns)
    if sheet.columns.time is not None:
        return Role("time", column=find_column(table, "time", sheet.columns.time))
    picks = [role for role in groups.get(("time", ""), ()) if not role.joint]
    picks.sort(key=lambda role: find_nanoseconds(role.column, names) is None)
    return picks[0] if picks else None
