"""Layout of a log: which columns hold which quantity of which joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from asbuilt.description.joint_matching import (
    find_unlabelled_joints,
    match_joints,
    read_label_numbers,
    split_words,
)
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.errors import RecordingError, refuse
from asbuilt.experiment.logs.columns.roles import (
    Role,
    find_nanoseconds,
    match_commanded_role,
    match_goal_role,
    parse_unit_scale,
    recognise,
    recognise_by_unit,
)
from asbuilt.experiment.logs.sheet import ColumnName, RecordingSheet
from asbuilt.experiment.recording import ENCODERS, TorqueSource
from asbuilt.findings import Cure

_QUANTITIES = ("position", "velocity", "acceleration", "torque", "command")
_SYMBOLS = {
    "q": "position",
    "qd": "velocity",
    "qdd": "acceleration",
    "tau": "torque",
    "q_command": "command",
}
_EXTRA_TORQUES = {"external": "tau_ext", "motor": "tau_motor", "sensor": "tau_sensor"}


@dataclass(frozen=True)
class Layout:
    """Columns of each quantity in joint order, and the factor of each column to SI.

    `quantities` has position, torque or command, and velocity, acceleration, and extras such as
    `tau_ext` where the log has them. A joint without a torque column has "" in its place.
    `nanoseconds` is a column to add to the time, `offsets` are added to columns in SI.
    """

    time: str | None
    quantities: Mapping[str, tuple[str, ...]]
    scales: Mapping[str, float]
    joint_names: tuple[str, ...]
    torque_source: TorqueSource = "unknown"
    notes: tuple[str, ...] = ()
    nanoseconds: str | None = None
    offsets: Mapping[str, float] = field(default_factory=dict)

    @property
    def columns(self) -> list[str]:
        """Every column that is needed, each once."""
        names = [name for group in self.quantities.values() for name in group if name]
        times = [each for each in (self.time, self.nanoseconds) if each]
        return list(dict.fromkeys([*times, *names]))


_Group = list[Role]
"""Columns of one quantity, with the joints that their names give."""


def find_layout(
    source: str,
    names: Sequence[str],
    *,
    model: RobotModel | None = None,
    sheet: RecordingSheet | None = None,
    known: Mapping[str, tuple[str, str]] | None = None,
    order: Sequence[str] = (),
    has_gains: bool = False,
) -> Layout:
    """Find the columns of each quantity from the sheet, what the format knows, and the usual names.

    The numbers of a sheet count the columns in `order`, by default `names`. `has_gains` says that
    gains are given in addition to the sheet's.

    Raises
    ------
    RecordingError
        If positions are missing, or both torques and commands, columns are missing or claim the
        same place, or they do not fit the robot's joints.
    """
    sheet = sheet or RecordingSheet()
    groups = _group_columns(
        names, {**_find_own_columns(names, model, sheet), **(known or {})}, sheet
    )
    for (quantity, kind), listed in sheet.columns.by_group.items():
        groups[quantity, kind] = _group_listed_columns(
            source, names, order, quantity, listed, sheet
        )
    position = groups.get(("position", ""))
    torque, torque_source = _choose_torque_group(groups)
    notes: list[str] = []
    either = groups.get(("command", "")) if torque is None else torque
    if position is None or either is None:
        absent = " and ".join(
            what
            for what, group in (("joint positions", position), ("joint torques", either))
            if group is None
        )
        listing = ", ".join(names[:40]) + (", ..." if len(names) > 40 else "")
        raise RecordingError(
            f"{source} has no columns for {absent}. Its columns are: {listing}",
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
        _refuse_unscaled(source, torque, sheet)
    chosen = _choose_groups(groups, position, torque)
    if torque is None:
        notes += _without_command(chosen, groups["command", ""])
    labels = _sort_labels(source, "position", position, sheet)
    ordered: dict[str, tuple[str, ...]] = {"position": tuple(_list_columns(position))}
    for quantity, group in chosen.items():
        if quantity == "position":
            continue
        if quantity in sheet.columns.extra and len(group) == 1:
            ordered[quantity] = (group[0].column,) * len(labels)
            continue
        if quantity == "torque" and sheet.columns.torque is None:
            some = _order_some_joints(group, position)
            if some is not None:
                ordered[quantity] = some
                continue
        try:
            ordered[quantity] = _align_columns(source, quantity, group, labels, sheet)
        except RecordingError:
            if quantity in _QUANTITIES and (quantity != "command" or torque is None):
                raise
            notes.append(
                f"the {len(group)} columns of {quantity} do not match the {len(labels)}"
                " joints and were left out"
            )
    joint_names = tuple(labels)
    if model is not None:
        joint_names, places, matched = _match_order(model, source, labels, position, sheet)
        beside_joints = _find_follower_columns(model, labels, ordered)
        ordered = {
            quantity: tuple(columns[k] for k in places) for quantity, columns in ordered.items()
        }
        ordered |= beside_joints
        notes.extend(matched)
    scales = _choose_scales(chosen, sheet, notes)
    time, time_scale = _find_time_column(source, names, order, groups, sheet)
    if time is not None:
        scales[time] = time_scale
    nanoseconds = find_nanoseconds(time, names) if time and sheet.columns.time is None else None
    return Layout(time, ordered, scales, joint_names, torque_source, tuple(notes), nanoseconds)


def _choose_groups(
    groups: Mapping[tuple[str, str], _Group], position: _Group, torque: _Group | None
) -> dict[str, _Group]:
    """Return the groups by the names of their quantities, extra torques under their own."""
    chosen = {"position": position} | ({} if torque is None else {"torque": torque})
    for (quantity, kind), group in groups.items():
        if group is position or group is torque or quantity == "time":
            continue
        if kind in ("", "sheet"):
            chosen[quantity] = group
        elif kind != "unscaled":
            of_torque = _EXTRA_TORQUES if quantity == "torque" else ENCODERS
            chosen[of_torque.get(kind, f"{quantity}_{kind}")] = group
    return chosen


def _without_command(chosen: Mapping[str, _Group], command: _Group) -> list[str]:
    """Leave out joints that no command is logged for, such as a gripper's, and say so."""
    commanded = {role.joint for role in command}
    joints = [role.joint for role in chosen["position"]]
    if "" in commanded or not commanded < set(joints):
        return []
    for group in chosen.values():
        group[:] = [role for role in group if role.joint in commanded]
    listed = ", ".join(joint for joint in joints if joint not in commanded)
    return [f"joints without a command were left out: {listed}"]


def _refuse_unscaled(source: str, torque: _Group, sheet: RecordingSheet) -> None:
    """Raise if the torques have a unit without a factor to N m, and no gains are given."""
    role = torque[0]
    if role.kind == "unscaled" and sheet.gains is None and sheet.units.torque is None:
        raise RecordingError(
            f"{source}: the {role.quantity} columns ({role.column}, ...) are in {role.unit},"
            " which does not say how many N m they are",
            cure=Cure(
                "give the torque per logged unit of each joint, such as a hundredth of its rated"
                " torque for percent",
                settings={"gain": None},
            ),
            file=source,
            value=role.unit,
        )


def _find_own_columns(
    names: Sequence[str], model: RobotModel | None, sheet: RecordingSheet
) -> dict[str, tuple[str, str]]:
    """Return the columns named exactly by a quantity's symbol and a joint of the robot.

    This holds for quantities that have such a column for every joint, so that no joint's name is
    mistaken for a word, as in `q_tau` of a joint called tau.
    """
    if model is None or sheet.joints is not None:
        return {}
    return {
        f"{symbols}_{joint}": (quantity, joint)
        for symbols, quantity in _SYMBOLS.items()
        if all(f"{symbols}_{joint}" in names for joint in model.joint_names)
        for joint in model.joint_names
    }


def _group_columns(
    names: Sequence[str], known: Mapping[str, tuple[str, str]], sheet: RecordingSheet
) -> dict[tuple[str, str], _Group]:
    renamed = sheet.joints if isinstance(sheet.joints, dict) else {}
    groups: dict[tuple[str, str], _Group] = {}
    for name in names:
        if name in known:
            quantity, joint = known[name]
            role: Role | None = Role(quantity, joint)  # type: ignore[arg-type]
        else:
            role = recognise(name) or match_commanded_role(name)
        if role is None:
            continue
        role = replace(role, joint=renamed.get(role.joint, role.joint), column=name)
        groups.setdefault((role.quantity, role.kind), []).append(role)
    for group in groups.values():
        _count_by_index(group)
    groups = _with_two_encoders(groups)
    return {**_group_by_unit(names, groups), **_find_goals(names, groups), **groups}


def _with_two_encoders(groups: dict[tuple[str, str], _Group]) -> dict[tuple[str, str], _Group]:
    """Return groups in which motor positions are the positions, and link positions a second set.

    Only where the others are called link positions; a log with positions of motors alone has no
    others.
    """
    motor, other = groups.get(("position", "motor")), groups.get(("position", ""))
    if motor is None:
        return groups
    rest = {key: each for key, each in groups.items() if key[0] != "position"}
    if other is None:
        return {**rest, ("position", ""): motor}
    labels = [split_words(role.joint) for role in other]
    if not all(words[:1] == ["link"] for words in labels):
        return groups
    other[:] = [replace(role, joint="") for role in other]
    return {**rest, ("position", ""): motor, ("position", "link"): other}


def _count_by_index(group: _Group) -> None:
    """Take out what all names of a group share, if they differ in a number alone.

    So that `/controller/feedback/positions[0]` counts joints, and names none.
    """
    numbers = [role.index for role in group]
    counts = None not in numbers and len(set(numbers)) == len(numbers) > 1
    if counts and len({role.joint for role in group}) == 1:
        group[:] = [replace(role, joint="") for role in group]


def _find_goals(
    names: Sequence[str], found: Mapping[tuple[str, str], _Group]
) -> dict[tuple[str, str], _Group]:
    """Return the commands that only a word such as setpoint names, one for each position."""
    position = found.get(("position", ""))
    if position is None:
        return {}
    goals = [
        replace(role, column=name) for name in names if (role := match_goal_role(name)) is not None
    ]
    _count_by_index(goals)
    matched = goals and sorted(_locate_joints(goals)) == sorted(_locate_joints(position))
    return {("command", ""): goals} if matched else {}


def _list_columns(group: _Group) -> list[str]:
    return [role.column for role in group]


def _locate_joints(group: _Group) -> list[tuple[str, int]]:
    """Return which joint each column belongs to, by name or else by number."""
    return [(role.joint, -1 if role.joint else role.index or 0) for role in group]


def _group_by_unit(
    names: Sequence[str], named: Mapping[tuple[str, str], _Group]
) -> dict[tuple[str, str], _Group]:
    """Return the columns of quantities that no column names, by their units."""
    found: dict[tuple[str, str], _Group] = {}
    quantities = {quantity for quantity, _ in named}
    for name in names:
        role = recognise_by_unit(name)
        if role is not None and role.quantity not in quantities:
            found.setdefault((role.quantity, ""), []).append(replace(role, column=name))
    if len(found.get(("time", ""), ())) > 1:
        del found["time", ""]
    return found


def _find_column(
    source: str, names: Sequence[str], order: Sequence[str], what: str, column: ColumnName
) -> str:
    if isinstance(column, int):
        counted = order or names
        if not 1 <= column <= len(counted):
            raise RecordingError(
                f"{source}: the sheet gives column {column} for {what}, but columns run from 1 to"
                f" {len(counted)}",
                file=source,
                value=column,
                lower=1,
                upper=len(counted),
            )
        name = counted[column - 1]
        if name not in names:
            raise RecordingError(
                f"{source}: the sheet gives column {column} ({name!r}) for {what}, which holds text"
                " in place of numbers",
                cure=Cure("count the columns of the file from 1, text columns too"),
                file=source,
                value=column,
            )
        return name
    if column in names:
        return column
    listing = ", ".join(names[:40]) + (", ..." if len(names) > 40 else "")
    raise RecordingError(
        f"{source}: the sheet gives column {column!r} for {what}, which the log does not have; it"
        f" has {listing}",
        file=source,
        value=column,
        available=list(names),
    )


def _group_listed_columns(
    source: str,
    names: Sequence[str],
    order: Sequence[str],
    what: str,
    columns: Sequence[ColumnName],
    sheet: RecordingSheet,
) -> _Group:
    found = [_find_column(source, names, order, what, column) for column in columns]
    repeated = next((name for name in found if found.count(name) > 1), None)
    labels = _list_joints(sheet) or ["" for _ in found]
    refuse(
        RecordingError,
        (
            repeated is not None,
            f"{source}: the sheet gives column {repeated!r} twice for {what}",
            {"file": source, "value": repeated},
        ),
        (
            len(labels) != len(found),
            f"{source}: the sheet names {len(labels)} joints but gives {len(found)} columns for"
            f" {what}",
            {"file": source, "value": len(found), "expected": len(labels)},
        ),
    )
    quantity = what if what in _QUANTITIES else "torque"
    return [
        Role(quantity, label, k, column=name)  # type: ignore[arg-type]
        for k, (label, name) in enumerate(zip(labels, found, strict=True), start=1)
    ]


def _list_joints(sheet: RecordingSheet) -> list[str] | None:
    """Return the joints in the order of the columns, None where the sheet does not list them."""
    return sheet.joints if isinstance(sheet.joints, list) else None


def _choose_torque_group(
    groups: Mapping[tuple[str, str], _Group],
) -> tuple[_Group | None, TorqueSource]:
    sources: dict[tuple[str, str], TorqueSource] = {
        ("torque", ""): "unknown",
        ("torque", "sensor"): "sensor",
        ("torque", "motor"): "motor",
        ("current", ""): "current",
        ("torque", "unscaled"): "unknown",
        ("current", "unscaled"): "current",
    }
    for key, torque_source in sources.items():
        if key in groups:
            return groups[key], torque_source
    return None, "unknown"


def _sort_labels(source: str, quantity: str, group: _Group, sheet: RecordingSheet) -> list[str]:
    """Sort a group by joint number if it only counts, and return its joint labels.

    If some columns name a joint, numbers are the names of the rest.
    """
    _refuse_repeats(source, quantity, group)
    listed = _list_joints(sheet)
    if listed is None and any(role.joint for role in group):
        group[:] = [
            role if role.joint or role.index is None else replace(role, joint=f"joint_{role.index}")
            for role in group
        ]
    if all(role.joint for role in group):
        labels = [role.joint for role in group]
        if listed is not None:
            _refuse_other_joints(source, quantity, labels, listed)
        return labels
    _sort_by_number(source, quantity, group)
    if listed is not None:
        if len(listed) != len(group):
            raise RecordingError(
                f"{source}: the sheet names {len(listed)} joints but the log has"
                f" {len(group)} {quantity} columns",
                file=source,
                value=len(group),
                expected=len(listed),
            )
        return list(listed)
    return [f"joint_{k}" for k in range(1, len(group) + 1)]


def _refuse_other_joints(
    source: str, quantity: str, labels: Sequence[str], listed: Sequence[str]
) -> None:
    """Raise if columns name their joints, and a sheet lists others; names tell the order."""
    if sorted(map(split_words, labels)) == sorted(map(split_words, listed)):
        return
    cure = Cure(
        "give the robot's name of each joint of the log in its place: [joints] with"
        f' "{labels[0]}" = "..." and so on'
    )
    raise RecordingError(
        f"{source}: the sheet lists the joints {', '.join(listed)}, but the {quantity} columns name"
        f" theirs, {', '.join(labels)}",
        cure=cure,
        file=source,
        value=list(listed),
        expected=list(labels),
    )


def _refuse_repeats(source: str, quantity: str, group: _Group) -> None:
    places: dict[tuple[str, int | None], str] = {}
    for role in group:
        place = (role.joint, None) if role.joint else ("", role.index)
        if place in places:
            raise RecordingError(
                f"{source}: columns {places[place]!r} and {role.column!r} both look like the"
                f" {quantity} of the same joint",
                cure=Cure(f"choose in a recording sheet: [columns] {quantity} = [...]"),
                file=source,
                value=[places[place], role.column],
            )
        places[place] = role.column


def _sort_by_number(source: str, quantity: str, group: _Group) -> None:
    group.sort(key=lambda role: (role.index is not None, role.index or 0))
    indices = [role.index for role in group if role.index is not None]
    if indices and len(indices) == len(group):
        start = 0 if indices[0] == 0 else 1
        missing = sorted(set(range(start, indices[-1] + 1)) - set(indices))
        if missing:
            raise RecordingError(
                f"{source}: the {quantity} column of joint number {missing[0]} is missing; there"
                f" are {', '.join(_list_columns(group))}",
                cure=Cure(
                    f"add it, or choose columns in a recording sheet: [columns] {quantity} = [...]"
                ),
                file=source,
                available=_list_columns(group),
            )


def _order_some_joints(group: _Group, position: _Group) -> tuple[str, ...] | None:
    """Return the columns in the order of the positions, "" for joints that have none.

    None where every joint has one, or the names do not say which joint each belongs to.
    """
    own = dict(zip(_locate_joints(group), _list_columns(group), strict=True))
    places = _locate_joints(position)
    if len(own) < len(group) or not set(own) < set(places):
        return None
    return tuple(own.get(place, "") for place in places)


def _align_columns(
    source: str, quantity: str, group: _Group, labels: Sequence[str], sheet: RecordingSheet
) -> tuple[str, ...]:
    """Return the columns of a group in the order of the position columns."""
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
    if list(own) == list(labels) or not all(role.joint for role in group):
        return tuple(columns)
    if set(own) == set(labels):
        return tuple(columns[own.index(label)] for label in labels)
    if all(label.startswith("joint_") for label in labels) and read_label_numbers(own) is not None:
        return tuple(
            name for _, name in sorted(zip(read_label_numbers(own) or [], columns, strict=True))
        )
    with suppress(RecordingError):
        order, assumed = match_joints(own, labels, source=source, robot=source)
        if not assumed:
            return tuple(columns[k] for k in order)
    raise RecordingError(
        f"{source}: joints of the {quantity} columns ({', '.join(own)}) are not the joints of the"
        f" position columns ({', '.join(labels)})",
        file=source,
        value=list(own),
        expected=list(labels),
    )


def _find_follower_columns(
    model: RobotModel, labels: Sequence[str], ordered: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Return the columns of position and torque of joints that follow others, by their names."""
    symbols = {"position": "q", "torque": "tau"}
    return {
        f"{symbol}_{joint.name}": (ordered[quantity][labels.index(joint.name)],)
        for joint in model.followers
        for quantity, symbol in symbols.items()
        if joint.name in labels and quantity in ordered
    }


def _match_order(
    model: RobotModel, source: str, labels: Sequence[str], position: _Group, sheet: RecordingSheet
) -> tuple[tuple[str, ...], list[int], tuple[str, ...]]:
    named = sheet.joints is not None or all(role.joint for role in position)
    if named and len(labels) > 1:
        following = {joint.name for joint in model.followers}
        own = [k for k, label in enumerate(labels) if label not in following]
        order, notes = match_joints(
            [labels[k] for k in own], model.joint_names, source=source, robot=model.name
        )
        return model.joint_names, [own[k] for k in order], notes
    if len(labels) != model.n_joints:
        missing = find_unlabelled_joints(labels, model.joint_names) if named else None
        beyond = ", ".join(model.joint_names[len(labels) :])
        more = f"; joints that the log lacks can be locked: {beyond}" if beyond else ""
        if model.followers:
            names = ", ".join(joint.name for joint in model.followers)
            more += f"; joints that follow others have no column: {names}"
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
    return model.joint_names, list(range(len(labels))), ()


def _find_gripper_joints(model: RobotModel, count: int) -> tuple[str, ...] | None:
    """Return the joints behind the first `count` if those are an arm and these its gripper.

    The arm is a chain of joints in order. The others hang on its last link, and are no continuation
    of it: several hang on one link, or all slide.
    """
    parents, rest = model.parents, model.joints[count:]
    chain = 0 < count < model.n_joints and parents[:count] == (ROOT, *range(count - 1))
    on = [joint.parent for joint in (*rest, *model.followers)]
    behind = all(parent >= count - 1 for parent in on)
    branched = len(set(on)) < len(on)
    slides = not any(joint.is_revolute for joint in rest)
    if not (chain and behind and (branched or slides)):
        return None
    return tuple(joint.name for joint in rest)


def _choose_scales(
    chosen: Mapping[str, _Group], sheet: RecordingSheet, notes: list[str]
) -> dict[str, float]:
    scales: dict[str, float] = {}
    for quantity, group in chosen.items():
        of_position = quantity in ENCODERS.values()
        unit = getattr(sheet.units, "position" if of_position else quantity, None)
        if quantity == "command" and unit is None and not any(role.unit for role in group):
            unit = sheet.units.position
        for role in group:
            scales[role.column] = role.scale if unit is None else parse_unit_scale(unit) or 1.0
        units = {role.unit for role in group if role.scale != 1.0}
        if unit is None and units:
            notes.append(f"{quantity} columns were converted from {', '.join(sorted(units))}")
    return scales


def _find_time_column(
    source: str,
    names: Sequence[str],
    order: Sequence[str],
    groups: Mapping[tuple[str, str], _Group],
    sheet: RecordingSheet,
) -> tuple[str | None, float]:
    unit = parse_unit_scale(sheet.units.time) if sheet.units.time else None
    if sheet.columns.time is not None:
        return _find_column(source, names, order, "time", sheet.columns.time), unit or 1.0
    group = groups.get(("time", ""))
    if group is None:
        return None, 1.0
    picks = [role for role in group if not role.joint]
    if not picks:
        return None, 1.0
    pick = next((role for role in picks if find_nanoseconds(role.column, names)), picks[0])
    return pick.column, unit or pick.scale
