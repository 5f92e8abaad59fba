"""Commands of joints: whose they are, and the times from which they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.ros.messages import KINDS, JointMessage
from asbuilt.experiment.logs.formats.ros.topics import Topics
from asbuilt.findings import Cure

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
                "list the joints in their order, that of the controller's parameter `joints`, in a"
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


def in_force(
    path: Path, topic: str, commands: list[JointMessage], starts: NDArray[np.int64], period: float
) -> tuple[list[JointMessage], NDArray[np.int64]]:
    """Return the commands in the order in which they begin to hold, and these times [ns].

    Points of a trajectory that another one replaced before their time are left out.

    Parameters
    ----------
    path, topic
        File and topic, for messages.
    commands
        The commands, those of trajectories point by point.
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
