"""Which column belongs to which joint, by name."""

from __future__ import annotations

from collections.abc import Sequence

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.roles import words_of

_GENERIC = {"joint", "joints", "jnt", "j", "axis", "link"}


def match_joints(
    labels: Sequence[str], joint_names: Sequence[str], *, source: str, robot: str
) -> tuple[list[int], tuple[str, ...]]:
    """Return, for each joint of the robot, the position of its label, and notes on what was
    assumed.

    Names are equal when their words are (`Shoulder-Pan` is `shoulder_pan_joint`), also behind a
    name space; joints that the robot does not have are left out, such as a gripper's, unless the
    labels only count them: a log of seven numbered joints is none of a robot with four. Labels that
    count (`lbr_joint_0`, ...) go to the robot's joints in numeric order when no name fits.

    Raises
    ------
    RecordingError
        If a joint of the robot has no label, or labels fit several joints.

    Examples
    --------
    >>> match_joints(["elbow", "wrist"], ["wrist_joint", "elbow_joint"], source="log", robot="arm")[0]
    [1, 0]
    """
    if len(labels) > len(joint_names) and numbers_in(labels) is not None:
        raise RecordingError(_misfit(labels, joint_names, source, robot))
    for simplify in (_itself, _words, _significant_words):
        keys = [simplify(label) for label in labels]
        wanted = [simplify(name) for name in joint_names]
        order = [keys.index(key) if keys.count(key) == 1 else -1 for key in wanted]
        if min(order) >= 0 and len(set(order)) == len(order):
            return order, _left_out(labels, order, source)
        ends = [
            [
                k
                for k, key in enumerate(keys)
                if key and (key[-len(want) :] == want or want[-len(key) :] == key)
            ]
            for want in wanted
        ]
        if all(len(end) == 1 for end in ends) and len({end[0] for end in ends}) == len(joint_names):
            order = [end[0] for end in ends]
            return order, _left_out(labels, order, source)
    counted = _in_numeric_order(labels)
    if counted is not None and len(labels) == len(joint_names):
        robot_order = _in_numeric_order(joint_names)
        places = list(range(len(joint_names))) if robot_order is None else robot_order
        order = [0] * len(labels)
        for label, joint in zip(counted, places, strict=True):
            order[joint] = label
        pairs = ", ".join(f"{labels[order[k]]} -> {joint_names[k]}" for k in range(len(order)))
        return order, (
            f"joint names of the log and of {robot} differ; they were matched by number: {pairs}",
        )
    raise RecordingError(_misfit(labels, joint_names, source, robot))


def numbers_in(labels: Sequence[str]) -> list[int] | None:
    """Return the number that counts the labels, or None where they differ in more than one number."""
    split = [words_of(label) for label in labels]
    if len({len(words) for words in split}) != 1 or len(labels) < 2:
        return None
    varying = [k for k in range(len(split[0])) if len({words[k] for words in split}) > 1]
    if len(varying) != 1 or not all(words[varying[0]].isdigit() for words in split):
        return None
    return [int(words[varying[0]]) for words in split]


def _misfit(labels: Sequence[str], joint_names: Sequence[str], source: str, robot: str) -> str:
    if len(labels) != len(joint_names):
        problem = f"{source} has {len(labels)} joints but {robot} has {len(joint_names)}"
    else:
        problem = f"the joint names of {source} do not fit {robot}"
    return (
        f"{problem}. Joints of the log: {', '.join(labels)}. Joints of {robot}:"
        f" {', '.join(joint_names)}. Choose the right robot, or say in a recording sheet which"
        " column is which: joints = [...] with the robot's names in column order."
    )


def _in_numeric_order(labels: Sequence[str]) -> list[int] | None:
    """Return the order that sorts labels by their number, if the numbers run on from 0 or 1 without
    a gap.
    """
    numbers = numbers_in(labels)
    if numbers is None or sorted(numbers) not in (
        list(range(len(labels))),
        list(range(1, len(labels) + 1)),
    ):
        return None
    return sorted(range(len(labels)), key=lambda k: numbers[k])


def _itself(name: str) -> tuple[str, ...]:
    return (name,)


def _words(name: str) -> tuple[str, ...]:
    return tuple(words_of(name))


def _significant_words(name: str) -> tuple[str, ...]:
    return tuple(word for word in words_of(name) if word not in _GENERIC)


def _left_out(labels: Sequence[str], order: list[int], source: str) -> tuple[str, ...]:
    rest = [label for k, label in enumerate(labels) if k not in order]
    return (
        (f"joints of {source} that the robot does not have were left out: {', '.join(rest)}",)
        if rest
        else ()
    )
