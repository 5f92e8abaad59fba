"""Table of joint states and of the commands that held at their times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable, tabulate_joints
from asbuilt.experiment.logs.formats.ros.messages import FIELDS, KINDS, JointMessage, Topics
from asbuilt.findings import Cure


def tabulate_joint_messages(
    path: Path,
    topics: Topics,
    types: Mapping[str, str],
    messages: Mapping[str, Sequence[tuple[int, Any]]],
    *,
    command_joints: Sequence[str] | None = None,
    required: bool = False,
) -> LogTable:
    """Return the messages of the chosen topics as a table with one row for each joint state.

    Joints are matched by name in every message; messages that name other joints than most are left
    out. The command of a row is the last one that held by then.

    Parameters
    ----------
    path
        The file, for messages.
    topics, types
        The topics, and the types of the messages of each.
    messages
        Messages of each topic with the times [ns] at which they were logged.
    command_joints
        Joints of commands that do not name theirs, in order.
    required
        Whether the commands are needed; otherwise those that cannot be used are left out with a
        note where the states have efforts.

    Raises
    ------
    RecordingError
        If there is neither an effort nor a command, or the commands cannot be used.
    """
    states = _select_states(path, topics, types, messages)
    names = _find_usual_names(states)
    kept = _select_naming(states, names)
    notes: list[str] = []
    try:
        commands = read_commands(path, topics, types, messages, command_joints)
        commanded, commands = _select_joints(path, topics, names, commands, command_joints or ())
        stamps, sent, commands = _choose_clock(path, topics, kept, commands)
    except RecordingError as problem:
        if required or not any(each.effort.size for each in kept):
            raise
        notes.append(f"commands were left out: {problem.message}")
        commanded, commands = (), []
        stamps, sent, commands = _choose_clock(path, topics, kept, commands)
    groups = [
        (field, quantity, names, values)
        for field, quantity in FIELDS
        if (values := _stack_values(kept, field, names)) is not None
    ]
    values = _stack_values(commands, "position", commanded) if commands else None
    if values is not None:
        last = np.searchsorted(sent, stamps, side="right") - 1
        if before := int(np.count_nonzero(last < 0)):
            notes.append(f"{before} states before the first command count as commanded like it")
        groups.append(("command", "command", commanded, values[np.maximum(last, 0)]))
    if not any(quantity in ("torque", "command") for _, quantity, joints, _ in groups if joints):
        raise _without_commands(path, topics, names)
    if dropped := len(states) - len(kept):
        notes.append(f"{dropped} of {len(states)} messages name other joints and were left out")
    return tabulate_joints(str(path), (stamps - stamps[0]).astype(np.float64) * 1e-9, groups, notes)


def _select_states(
    path: Path,
    topics: Topics,
    types: Mapping[str, str],
    messages: Mapping[str, Sequence[tuple[int, Any]]],
) -> list[JointMessage]:
    """Return the states that hold positions; raises `RecordingError` if none does."""
    read = KINDS[types[topics.states]].states if topics.states else None
    states = [
        each
        for logged, message in (messages[str(topics.states)] if read else ())
        for each in read(logged, message)  # type: ignore[misc]
        if each.names
    ]
    if not states:
        listing = ", ".join(sorted(types)) or "none"
        raise RecordingError(
            f"{path} is not a recording: no topic holds positions of joints (topics: {listing})",
            cure=Cure("record the joint states' topic"),
            file=str(path),
        )
    return states


def _select_joints(
    path: Path,
    topics: Topics,
    names: tuple[str, ...],
    commands: list[JointMessage],
    listed: Sequence[str],
) -> tuple[tuple[str, ...], list[JointMessage]]:
    """Return the joints of the states that are commanded, and the commands that name them all."""
    if not commands:
        return (), []
    others = _find_usual_names(commands)
    commanded = tuple(name for name in names if name in others)
    unknown = [name for name in listed if name in others and name not in names]
    if not commanded or unknown:
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
    return commanded, _select_naming(commands, commanded)


def _without_commands(path: Path, topics: Topics, names: Sequence[str]) -> RecordingError:
    several = topics.candidates if topics.commands is None else ()
    lack = f"{', '.join(several)} may each hold" if several else "no topic holds"
    return RecordingError(
        f"{path}: the joint states of {', '.join(names)} have no effort, and {lack} their commands;"
        " torques, currents or commanded positions are required",
        cure=Cure('name the topic of the commands in a recording sheet: command_topic = "..."'),
        file=str(path),
        available=list(several),
    )


def _select_naming(states: list[JointMessage], names: Sequence[str]) -> list[JointMessage]:
    """Return the messages that name all of these joints."""
    wanted = set(names)
    return [state for state in states if wanted <= set(state.names)]


def _find_usual_names(states: list[JointMessage]) -> tuple[str, ...]:
    """Return the joints of the most frequent kind of message that carries efforts."""
    votes: dict[tuple[str, ...], int] = {}
    for state in states:
        weight = 1000 if state.effort.size == len(state.names) > 0 else 1
        key = tuple(sorted(state.names))
        votes[key] = votes.get(key, 0) + weight
    best = max(votes, key=lambda key: (votes[key], len(key)))
    return next(state.names for state in states if tuple(sorted(state.names)) == best)


def _choose_clock(
    path: Path, topics: Topics, states: list[JointMessage], commands: list[JointMessage]
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[JointMessage]]:
    """Return the times [ns] of states and commands by one clock, and the commands in their order.

    It is the headers' clock, unless one of them has none.
    """
    groups = [each for each in (states, commands) if each]
    stamped = all(_is_stamped(each) for each in groups)
    own, starts = (
        np.array([each.stamp if stamped else each.logged for each in group], dtype=np.int64)
        for group in (states, commands)
    )
    if not commands:
        return own, starts, []
    period = float(np.median(np.diff(own))) if own.size > 1 else 0.0
    commands, sent = order_commands(path, str(topics.commands), commands, starts, period)
    return own, sent, commands


def _is_stamped(messages: Sequence[JointMessage]) -> bool:
    """Return whether the headers of messages have times, which differ as logging times do."""
    stamps = np.array([each.stamp for each in messages], dtype=np.int64)
    distinct, logged = len(np.unique(stamps)), len({each.logged for each in messages})
    unset = int(np.count_nonzero(stamps == 0))
    return unset <= min(1, distinct - 1) and 2 * distinct >= logged


def _stack_values(states: list[JointMessage], field: str, names: tuple[str, ...]) -> Array | None:
    values = np.full((len(states), len(names)), np.nan)
    order: dict[tuple[str, ...], list[int]] = {}
    for row, state in enumerate(states):
        logged = getattr(state, field)
        key = state.names
        if len(logged) != len(key):
            continue
        if key not in order:
            order[key] = [key.index(name) for name in names]
        values[row] = logged[order[key]]
    return None if np.all(np.isnan(values)) else values


SPARSE = 5.0
"""Periods of the states between points of a trajectory beyond which the way between them matters:
a point that is held is late by half its distance."""
_STATE = (
    "record the state of the controller, whose reference is what it commanded, such as"
    " /joint_trajectory_controller/controller_state"
)


def read_commands(
    path: Path,
    topics: Topics,
    types: Mapping[str, str],
    messages: Mapping[str, Sequence[tuple[int, Any]]],
    joints: Sequence[str] | None,
) -> list[JointMessage]:
    """Return the commands, with the names of their joints."""
    if topics.commands is None:
        return []
    read = KINDS[types[topics.commands]].commands
    assert read is not None
    commands = [
        each for logged, message in messages[topics.commands] for each in read(logged, message)
    ]
    nameless = [each for each in commands if not each.names]
    if not nameless:
        return commands
    sizes = {each.position.size for each in nameless}
    count = ", ".join(map(str, sorted(sizes)))
    if joints is None:
        raise RecordingError(
            f"{path}: the messages of {topics.commands} ({types[topics.commands]}) hold {count}"
            " numbers without the names of their joints",
            cure=Cure(
                "list the joints in the order of the controller's parameter `joints`, in a"
                ' recording sheet: command_joints = ["...", "..."]'
            ),
            file=str(path),
            value=topics.commands,
        )
    if sizes != {len(joints)} or len(set(joints)) < len(joints):
        raise RecordingError(
            f"{path}: the sheet lists {len(set(joints))} command_joints, but the messages of"
            f" {topics.commands} hold {count} numbers",
            cure=Cure("list one joint for each number, in their order"),
            file=str(path),
            value=len(joints),
            expected=sorted(sizes),
        )
    return [each if each.names else replace(each, names=tuple(joints)) for each in commands]


def order_commands(
    path: Path, topic: str, commands: list[JointMessage], starts: NDArray[np.int64], period: float
) -> tuple[list[JointMessage], NDArray[np.int64]]:
    """Return the commands in the order in which they begin to hold, and these times [ns].

    Points of a trajectory that another one replaced before their time are left out.

    Parameters
    ----------
    path, topic
        File and topic, for messages.
    commands
        The commands; trajectories give them point by point.
    starts
        Times of their messages [ns].
    period
        Median period of the states [ns].

    Raises
    ------
    RecordingError
        If a controller chose the way to the points by itself: they are far apart, or most were
        replaced before their time.
    """
    after = np.array([each.after for each in commands], dtype=np.int64)
    sent = starts + after
    if after.any():
        _refuse_sparse(path, topic, commands, period)
        distinct = np.append(np.unique(starts), np.iinfo(np.int64).max)
        kept = np.flatnonzero(sent < distinct[np.searchsorted(distinct, starts, side="right")])
        if 2 * kept.size < len(commands):
            raise RecordingError(
                f"{path}: {len(commands) - kept.size} of {len(commands)} points of the trajectories"
                f" of {topic} were replaced by the next trajectory before their time; the way"
                " toward them is the controller's own and not in the log",
                cure=Cure(_STATE),
                file=str(path),
                value=len(commands) - int(kept.size),
            )
        sent, commands = sent[kept], [commands[k] for k in kept]
    order = np.argsort(sent, kind="stable")
    return [commands[k] for k in order], sent[order]


def _refuse_sparse(path: Path, topic: str, commands: list[JointMessage], period: float) -> None:
    gap = max(
        now.after - (before.after if now.logged == before.logged else 0)
        for before, now in zip([commands[0], *commands[:-1]], commands, strict=True)
    )
    if gap <= SPARSE * period:
        return
    raise RecordingError(
        f"{path}: points of the trajectories of {topic} come {gap * 1e-9:.3g} s after the one"
        f" before, and the states every {period * 1e-9:.3g} s; the way between the points is the"
        " controller's own and not in the log",
        cure=Cure(_STATE),
        file=str(path),
        value=gap * 1e-9,
        upper=SPARSE * period * 1e-9,
    )
