"""Table of joint states, commands and states of a base at their times; joint states as text."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array, find_finite_rows
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import (
    LogTable,
    hold_last,
    measure_gaps,
    tabulate_joints,
)
from asbuilt.experiment.logs.formats.ros.messages import (
    FIELDS,
    FLAG,
    KINDS,
    SPARSE,
    JointMessage,
    Topics,
    is_stamped,
    name_contact,
    read_frames,
    read_times,
)
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.findings import Cure

Messages = Mapping[str, Sequence[tuple[int, Any]]]
"""Messages of each topic with the times [ns] at which they were logged."""


def tabulate_joint_messages(topics: Topics, messages: Messages, sheet: RecordingSheet) -> LogTable:
    """Return the messages of the chosen topics as `tabulate_joint_states` does."""
    states, commands = (
        _read_topic(topics, messages, getattr(topics, role), role)
        for role in ("states", "commands")
    )
    base = {each: _read_topic(topics, messages, each, "base") for each in topics.base}
    frames: dict[str, str] = {}
    for topic in topics.base:
        for _, message in messages[topic][:1]:
            frames |= read_frames(message)
    return replace(tabulate_joint_states(topics, states, commands, sheet, base), frames=frames)


def tabulate_joint_states(
    topics: Topics,
    states: Sequence[JointMessage],
    commands: list[JointMessage],
    sheet: RecordingSheet,
    base: Mapping[str, list[JointMessage]] = MappingProxyType({}),
) -> LogTable:
    """Return states and commands as a table with one row for each joint state.

    Joints are matched by name in every message. Publishers that share the topic and have a part of
    the joints each are joined by time; messages that name other joints than these are left out. The
    command of a row is the last one that held by then. Commands that cannot be used are
    left out with a note where the states have efforts, unless they are required.

    Raises
    ------
    RecordingError
        If there is neither an effort nor a command, or the commands cannot be used.
    """
    states = [state for state in states if state.names]
    if not states:
        listing = ", ".join(sorted(topics.types)) or "none"
        raise RecordingError(
            f"{topics.path} is not a recording: no topic holds positions of joints (topics:"
            f" {listing})",
            cure=Cure("record the joint states' topic"),
            file=str(topics.path),
        )
    publishers = _list_publishers(states)
    names = _find_usual_names(states)
    kept = _select_naming(states, names)
    stamped = is_stamped(kept)
    notes: list[str] = []
    joined = 0
    stamps = read_times(kept, stamped)
    try:
        commands = _select_commands(topics, commands, names, sheet)
        both = stamped and (not commands or is_stamped(commands))
        own = read_times(kept, both)
        sent, commands = order_commands(topics, commands, read_times(commands, both), own)
        stamps = own
    except RecordingError as problem:
        if sheet.names_commands or not any(each.effort.size for each in kept):
            raise
        notes.append(f"commands were left out: {problem.message}")
        commands = []
    groups = [
        (field, quantity, names, values)
        for field, quantity in FIELDS
        if (values := _stack_values(kept, field, names)) is not None
    ]
    for others in publishers:
        if not set(others) & set(names):
            of_others = _select_naming(states, others)
            groups += _join_publisher(of_others, others, stamps, stamped)
            notes.append(
                f"{len(of_others)} messages name {', '.join(others)} alone and were interpolated at"
                f" the times of the {len(kept)} that name {', '.join(names)}"
            )
            joined += len(of_others)
    commanded = tuple(name for name in names if commands and name in commands[0].names)
    values = _stack_values(commands, "position", commanded) if commands else None
    if values is not None:
        held, more = hold_last(stamps, sent, values)
        notes += more
        groups.append(("command", "command", commanded, held))
    if not any(quantity in ("torque", "command") for _, quantity, _, _ in groups):
        several = topics.candidates if topics.commands is None else ()
        lack = f"{', '.join(several)} may each hold" if several else "no topic holds"
        raise RecordingError(
            f"{topics.path}: the joint states of {', '.join(names)} have no effort, and {lack}"
            " their commands; torques, currents or commanded positions are required",
            cure=Cure('name the topic of the commands in a recording sheet: command_topic = "..."'),
            file=str(topics.path),
            available=list(several),
        )
    if dropped := len(states) - len(kept) - joined:
        notes.append(f"{dropped} of {len(states)} messages name other joints and were left out")
    t = (stamps - stamps[0]).astype(np.float64) * 1e-9
    table = tabulate_joints(str(topics.path), t, groups, notes)
    logged = {topic: found for topic, found in base.items() if found}
    return _add_base_states(table, topics, logged, kept) if logged or topics.unread else table


def _read_topic(
    topics: Topics, messages: Messages, topic: str | None, role: str
) -> list[JointMessage]:
    """Return the joints of a topic of states or of commands, or the states of the base."""
    if topic is None:
        return []
    read = KINDS[topics.types[topic]][role]
    return [each for at, message in messages[topic] for each in read(at, message)]


def _select_commands(
    topics: Topics, commands: list[JointMessage], names: Sequence[str], sheet: RecordingSheet
) -> list[JointMessage]:
    """Return the commands that name all joints which are mostly commanded.

    Numbers alone get the names of `sheet.command_joints`. Raises `RecordingError` if these do not
    fit, or the states have none of the joints.
    """
    listed = sheet.command_joints
    path = topics.path
    sizes = {command.position.size for command in commands if not command.names}
    count = ", ".join(map(str, sorted(sizes)))
    distinct = set(listed or ())
    if sizes and listed is None:
        raise RecordingError(
            f"{path}: the messages of {topics.commands}"
            f" ({topics.types.get(str(topics.commands))}) hold {count} numbers without the names of"
            " their joints",
            cure=Cure(
                "list the joints in the order of the controller's parameter `joints`, in a"
                ' recording sheet: command_joints = ["...", "..."]'
            ),
            file=str(path),
            value=topics.commands,
        )
    if sizes and (sizes != {len(listed or ())} or len(distinct) < len(listed or ())):
        raise RecordingError(
            f"{path}: the sheet lists {len(distinct)} command_joints, but the messages of"
            f" {topics.commands} hold {count} numbers",
            cure=Cure("list one joint for each number, in their order"),
            file=str(path),
            value=len(listed or ()),
            expected=sorted(sizes),
        )
    commands = [
        command if command.names else replace(command, names=tuple(listed or ()))
        for command in commands
    ]
    others = _find_usual_names(commands) if commands else ()
    if commands and (not {*names} & {*others} or not distinct & {*others} <= {*names}):
        raise RecordingError(
            f"{path}: the commands of {topics.commands} name {', '.join(others)}, and the"
            f" joint states of {topics.states} name {', '.join(names)}",
            cure=Cure(
                "name the topics that belong together, or the joints of the commands as the states"
                " do, in a recording sheet: topic, command_topic, command_joints"
            ),
            file=str(path),
            value=list(others),
            expected=list(names),
        )
    return _select_naming(commands, [name for name in names if name in others])


def _select_naming(states: list[JointMessage], names: Sequence[str]) -> list[JointMessage]:
    """Return the messages that name all of these joints."""
    wanted = set(names)
    return [state for state in states if wanted <= set(state.names)]


def _find_usual_names(states: list[JointMessage]) -> tuple[str, ...]:
    """Return the joints of the most frequent kind of message that carries efforts."""
    votes = Counter[tuple[str, ...]]()
    for state in states:
        votes[tuple(sorted(state.names))] += 1000 if state.effort.size == len(state.names) else 1
    best = max(votes, key=lambda key: (votes[key], len(key)))
    return next(state.names for state in states if tuple(sorted(state.names)) == best)


PUBLISHER = 0.2
"""Messages of other joints, relative to the most frequent, from which they are a publisher's of its
own: a gripper that reports now and then is none."""


def _list_publishers(states: Sequence[JointMessage]) -> list[tuple[str, ...]]:
    """Return the joints of each publisher of complete messages on a topic, if there are several.

    Those of different publishers are different joints, and all of them have efforts.
    """
    counts = Counter[frozenset[str]]()
    orders: dict[frozenset[str], tuple[str, ...]] = {}
    for state in states:
        joints = frozenset(state.names)
        orders.setdefault(joints, state.names)
        counts[joints] += state.effort.size == len(state.names)
    most = max(counts.values(), default=0)
    found = [orders[joints] for joints, count in counts.items() if count > PUBLISHER * most]
    named = [name for names in found for name in names]
    apart = len(set(named)) == len(named)
    return found if len(found) > 1 and apart else []


def _join_publisher(
    states: list[JointMessage], names: tuple[str, ...], at: NDArray[np.int64], stamped: bool
) -> list[tuple[str, str, tuple[str, ...], Array]]:
    """Return the values of a publisher at the times [ns] of another, NaN in its gaps."""
    own = read_times(states, stamped)
    order = np.argsort(own, kind="stable")
    own = own[order]
    t = (own - own[0]).astype(np.float64)
    wanted = (at - own[0]).astype(np.float64)
    period = float(np.median(np.diff(t))) if t.size > 1 else 0.0
    gap = measure_gaps(wanted, t) > SPARSE * period
    # A message that comes within a period of the ends holds there.
    beyond = (wanted < t[0] - period) | (wanted > t[-1] + period)
    groups = []
    for field, quantity in FIELDS:
        values = _stack_values(states, field, names)
        if values is None:
            continue
        columns = [np.interp(wanted, t, column) for column in values[order].T]
        joined = np.where((gap | beyond)[:, None], np.nan, np.column_stack(columns))
        groups.append((field, quantity, names, joined))
    return groups


def _stack_values(states: list[JointMessage], field: str, names: Sequence[str]) -> Array | None:
    """Return the values of joints (N, n), NaN where a message has none; None if none has any."""
    values = np.full((len(states), len(names)), np.nan)
    orders: dict[tuple[str, ...], list[int]] = {}
    for row, state in enumerate(states):
        logged = getattr(state, field)
        if len(logged) == len(state.names):
            if state.names not in orders:
                orders[state.names] = [state.names.index(name) for name in names]
            values[row] = logged[orders[state.names]]
    return None if np.all(np.isnan(values)) else values


def order_commands(
    topics: Topics,
    commands: list[JointMessage],
    starts: NDArray[np.int64],
    states: NDArray[np.int64],
) -> tuple[NDArray[np.int64], list[JointMessage]]:
    """Return the times [ns] at which commands begin to hold, and the commands, in their order.

    Points of a trajectory that another one replaced before their time are left out.

    Parameters
    ----------
    topics
        File and topic, for messages.
    commands
        The commands; trajectories give them point by point.
    starts, states
        Times of their messages, and of the states [ns].

    Raises
    ------
    RecordingError
        If a controller chose the way to the points by itself: they are far apart, or most were
        replaced before their time.
    """
    after = np.array([command.after for command in commands], dtype=np.int64)
    sent = starts + after
    if after.any():
        period = float(np.median(np.diff(states))) if states.size > 1 else 0.0
        follows = np.diff([command.logged for command in commands], prepend=-1) == 0
        gap = int(np.max(after - np.where(follows, np.roll(after, 1), 0)))
        distinct = np.append(np.unique(starts), np.iinfo(np.int64).max)
        kept = np.flatnonzero(sent < distinct[np.searchsorted(distinct, starts, side="right")])
        cure = Cure(
            "record the state of the controller, whose reference is what it commanded, such as"
            " /joint_trajectory_controller/controller_state"
        )
        if gap > SPARSE * period:
            raise RecordingError(
                f"{topics.path}: points of the trajectories of {topics.commands} come"
                f" {gap * 1e-9:.3g} s after the one before, and the states every"
                f" {period * 1e-9:.3g} s; the way between the points is the controller's own and"
                " not in the log",
                cure=cure,
                file=str(topics.path),
                value=gap * 1e-9,
                upper=SPARSE * period * 1e-9,
            )
        if 2 * kept.size < len(commands):
            raise RecordingError(
                f"{topics.path}: {len(commands) - kept.size} of {len(commands)} points of the"
                f" trajectories of {topics.commands} were replaced by the next trajectory before"
                " their time; the way toward them is the controller's own and not in the log",
                cure=cure,
                file=str(topics.path),
                value=len(commands) - int(kept.size),
            )
        sent = sent[kept]
        commands = [commands[k] for k in kept]
    order = np.argsort(sent, kind="stable")
    return sent[order], [commands[k] for k in order]


SLOWER = 1.05
"""Ratio of periods from which a topic is slower than another, not as fast with some jitter."""


def _add_base_states(
    table: LogTable,
    topics: Topics,
    messages: Mapping[str, list[JointMessage]],
    states: list[JointMessage],
) -> LogTable:
    """Return the table with columns of the base at the times of the joint states.

    Between two messages values follow a cubic spline; before the first, after the last, and
    where messages are missing they are NaN. Flags hold until the next one. A topic that is much
    slower than the joint states is left out, and the table says why in `unread`.
    """
    columns = dict(table.columns)
    unread = dict(topics.unread)
    notes = list(table.notes)
    for topic, found in messages.items():
        both = is_stamped(states) and is_stamped(found)
        rows = read_times(states, both)
        times, first = np.unique(read_times(found, both), return_index=True)
        names = max((each.names for each in found), key=len)
        complete = np.array([found[k].names == names for k in first])
        values = np.array([found[k].position for k in first[complete]])
        if topics.types[topic] == FLAG:
            columns[f"contact_{name_contact(topic)}"] = hold_last(rows, times, values[:, 0])[0]
            continue
        group = "_".join(names[0].split("_")[:-1]) if names else "imu"
        period, own = (_measure_period(each) for each in (times[complete], rows))
        rates = f"{topic} has {1e9 / period:.3g} Hz and the joint states {1e9 / own:.3g} Hz"
        sampled = _resample(rows, times[complete], values, names, period)
        if not np.isfinite(sampled).any():
            unread[group] = (
                f"{topics.path}: {topic} has no value at the time of any joint state",
                "record both by one clock, and what the sensor measures",
            )
        elif period > SPARSE * own:
            unread[group] = (
                f"{topics.path}: {rates}, so that how the base moves between its messages is not"
                " in the log",
                f"record it at {1e9 / (SPARSE * own):.3g} Hz or faster, or another source",
            )
        else:
            columns |= zip(names, sampled.T, strict=True)
            if period > SLOWER * own:
                notes.append(f"{rates}: motion above {0.5e9 / period:.3g} Hz is not in it")
    known = {name: table.known.get(name, ("", "")) for name in columns if name != "time"}
    return replace(table, columns=columns, known=known, unread=unread, notes=tuple(notes))


def _measure_period(times: NDArray[np.int64]) -> float:
    """Return the median time between messages [ns], at least one; infinite for fewer than two."""
    return max(float(np.median(np.diff(times))), 1.0) if times.size > 1 else np.inf


def _resample(
    rows: NDArray[np.int64],
    times: NDArray[np.int64],
    values: Array,
    names: tuple[str, ...],
    period: float,
) -> Array:
    """Return values (N, k) at other times (M,) [ns], NaN where they are unknown, (M, k).

    A quaternion and its opposite are one rotation: signs go on without a jump, and lengths are
    interpolated too, so that one which is not normalised is still seen.
    """
    turn = [
        k for k, name in enumerate(names) if name.rpartition("_")[2] in ("qx", "qy", "qz", "qw")
    ]
    known = find_finite_rows(values)
    times = times[known]
    values = values[known]
    if turn and len(values):
        flips = np.sum(values[1:, turn] * values[:-1, turn], axis=1) < 0.0
        values[1:, turn] *= np.cumprod(np.where(flips, -1.0, 1.0))[:, None]
    out = np.full((rows.size, len(names)), np.nan)
    if len(values) < 4 or not names:
        return out
    after = np.searchsorted(times, rows)
    exact = times[np.minimum(after, times.size - 1)] == rows
    near = measure_gaps(rows, times) <= SPARSE * period
    inside = (rows >= times[0]) & (rows <= times[-1]) & (near | exact)
    start = times[0]
    t = (times - start) * 1e-9
    at = (rows[inside] - start) * 1e-9
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - light start

    out[inside] = CubicSpline(t, values)(at)
    if turn:
        length = np.interp(at, t, np.linalg.norm(values[:, turn], axis=1))
        found = out[np.ix_(inside, turn)]
        out[np.ix_(inside, turn)] = found * (length / np.linalg.norm(found, axis=1))[:, None]
    out[exact] = values[after[exact]]  # to the last digit
    return out


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)


def is_topic_echo(line: str) -> bool:
    """Return whether a line of a file without header is an echoed joint state."""
    return _parse_line(line) is not None


def read_topic_echo(path: Path) -> LogTable:
    """Read a file of echoed joint states; joints are matched by name in every line.

    Raises
    ------
    RecordingError
        If a line is no joint state, or none has an effort.
    """
    states: list[JointMessage] = []
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            state = _parse_line(line)
            if state is not None:
                states.append(state)
            elif line.strip() not in ("", "---"):
                raise RecordingError(
                    f"{path}, line {number}: it is not a joint state",
                    cure=Cure("remove the line"),
                    file=str(path),
                    line=number,
                )
    return tabulate_joint_states(Topics(path, {}, "the file", None), states, [], RecordingSheet())


def _parse_line(line: str) -> JointMessage | None:
    """Return the joint state of a line that `ros2 topic echo` prints as CSV; None if it is none.

    A line has seconds, nanoseconds, the frame, the names of the joints, then positions, velocities
    and efforts; an empty field stands for an empty array.
    """
    fields = [field.strip() for field in line.strip("\r\n").split(",")]
    if len(fields) < 7 or not (fields[0].isdigit() and fields[1].isdigit()):
        return None
    numeric = [k for k in range(3, len(fields)) if not fields[k] or _NUMBER.fullmatch(fields[k])]
    first = numeric[0] if numeric else len(fields)
    names = tuple(fields[3:first])
    rest = fields[first:]
    values = []
    for _ in range(3):
        count = len(names) if rest and rest[0] else 1
        values.append(rest[:count] if rest and rest[0] else [])
        full = len(rest) >= count
        rest = rest[count:]
        if not full or not all(map(_NUMBER.fullmatch, values[-1])):
            return None
    if rest or not names or len(set(names)) < len(names):
        return None
    stamp = int(fields[0]) * 10**9 + int(fields[1])
    q, qd, tau = (np.array(value, dtype=np.float64) for value in values)
    return JointMessage(stamp, stamp, names, q, qd, tau)
