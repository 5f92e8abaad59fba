"""Choice of the topics that hold the joint states and their commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from asbuilt.description.joint_matching import words_of
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.roles import names_command
from asbuilt.experiment.logs.formats.ros.messages import (
    ARRAY,
    CONTROLLER_STATE,
    JOINT_STATE,
    KINDS,
    TRAJECTORY,
)
from asbuilt.findings import Cure

_NOT_POSITIONS = {
    *("effort", "efforts", "torque", "torques", "current", "force"),
    *("velocity", "velocities", "vel", "speed", "acceleration"),
}
"""Words in the name of a topic whose numbers are no positions."""


@dataclass(frozen=True, slots=True)
class Topics:
    """Hold the topics of states and of commands, None where there is none.

    `candidates` are all that may hold commands.
    """

    states: str | None
    commands: str | None
    candidates: tuple[str, ...] = ()


def chosen_topics(
    path: Path, topics: Mapping[str, str], topic: str | None, command_topic: str | None
) -> Topics:
    """Choose among topics, given the type of the messages of each.

    States are `topic`; else `/joint_states`, the only topic of joint states whose name does not say
    command, desired, target or the like, or the only one of a controller's states. Commands are
    `command_topic`; else the reference of the only controller's state; else the only topic of joint
    states, of trajectories, or of numbers, whose type or name says that it holds commands.

    Raises
    ------
    RecordingError
        If it is not clear which topic holds the states, or one does not exist.
    """
    of_states = {each for each, kind in topics.items() if KINDS[kind].states}
    of_commands = {each for each, kind in topics.items() if KINDS[kind].commands}
    _refuse_unknown(path, topic, of_states, "joint states")
    _refuse_unknown(path, command_topic, of_commands, "joint states or commands of joints")
    states = _states(path, topics, of_states, command_topic) if topic is None else topic
    candidates = tuple(
        sorted(each for each in of_commands if _holds_commands(each, topics[each], states))
    )
    if command_topic is None:
        controllers = [each for each in candidates if topics[each] == CONTROLLER_STATE]
        best = controllers if len(controllers) == 1 else candidates
        command_topic = best[0] if len(best) == 1 else None
    return Topics(states, command_topic, candidates)


def _refuse_unknown(path: Path, topic: str | None, known: set[str], what: str) -> None:
    if topic is None or topic in known:
        return
    raise RecordingError(
        f"{path} has no {what} on topic {topic!r}; it has them on"
        f" {', '.join(sorted(known)) or 'no topic'}",
        file=str(path),
        value=topic,
        available=sorted(known),
    )


def _states(
    path: Path, topics: Mapping[str, str], of_states: set[str], command_topic: str | None
) -> str | None:
    """Return the topic of the states, where none is given."""
    if "/joint_states" in of_states:
        return "/joint_states"
    measured = {
        each
        for each in of_states
        if topics[each] == CONTROLLER_STATE or (each != command_topic and not names_command(each))
    }
    by_kind: dict[str, list[str]] = {}
    for each in sorted(measured or of_states):
        by_kind.setdefault(topics[each], []).append(each)
    best = next((by_kind[kind] for kind in KINDS if kind in by_kind), [])
    if len(best) > 1:
        raise RecordingError(
            f"{path} has joint states on {len(best)} topics ({', '.join(best)})",
            cure=Cure('choose one in a recording sheet: topic = "..."'),
            file=str(path),
            available=best,
        )
    return best[0] if best else None


def _holds_commands(topic: str, kind: str, states: str | None) -> bool:
    """Return whether the type of a topic or its name says that it holds commanded positions."""
    if kind in (CONTROLLER_STATE, TRAJECTORY):
        return True
    if topic == states or not names_command(topic):
        return False
    return kind == JOINT_STATE or (kind == ARRAY and not _NOT_POSITIONS & set(words_of(topic)))
