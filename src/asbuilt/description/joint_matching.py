"""Matching of the columns of logs and motions to joints by name."""

from __future__ import annotations

import operator
import re
from collections.abc import Iterator, Sequence
from itertools import compress

import numpy as np

from asbuilt.arrays import Mask
from asbuilt.errors import RecordingError
from asbuilt.findings import Cure

WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
"""A word or a number of a name."""
_GENERIC = {"joint", "joints", "jnt", "j", "axis", "link"}
GRIPPERS = {"gripper", "grippers", "jaw", "jaws", "finger", "fingers"}
"""Words in the name of a joint that is often logged as a share of its range."""


def split_words(name: str) -> list[str]:
    """Split a name into words and numbers: "jointTorque_1" -> ["joint", "torque", "1"]."""
    return [word.lower() for word in WORD.findall(name.replace("τ", "tau").replace("θ", "theta"))]


def names_gripper(joint: str) -> bool:
    """Return whether a joint has the name of a gripper.

    >>> [names_gripper(each) for each in ("left_gripper", "Jaw", "wrist_roll")]
    [True, True, False]
    """
    return bool(GRIPPERS & set(split_words(joint)))


def match_joints(
    labels: Sequence[str], joint_names: Sequence[str], *, source: str, robot: str
) -> tuple[list[int], tuple[str, ...]]:
    """Return the position of each joint's label, and notes on what was assumed.

    Names are equal if their words are (`Shoulder-Pan` is `shoulder_pan_joint`), also behind a name
    space; a number alone is a name where both sides only count (`wrist_1_joint` next to
    `elbow_joint` is no `joint_1`). Joints that the robot does not have, such as a gripper's, are
    left out, unless the labels only count them. If no name fits, labels that count
    (`lbr_joint_0`, ...) are matched to the robot's joints in numeric order.

    Raises
    ------
    RecordingError
        If a joint of the robot has no label, or labels fit several joints.

    Examples
    --------
    >>> joints = ["wrist_joint", "elbow_joint"]
    >>> match_joints(["elbow", "wrist"], joints, source="log", robot="arm")[0]
    [1, 0]
    """
    if len(labels) > len(joint_names) and read_label_numbers(labels) is not None:
        raise _make_misfit_error(labels, joint_names, source, robot)
    for alike in _compare_names(labels, joint_names):
        if (alike.sum(axis=0) == 1).all() and (alike.sum(axis=1) <= 1).all():
            order = alike.argmax(axis=0).tolist()
            return order, _note_left_out(labels, order, source)
    counted = _sort_numerically(labels)
    if counted is not None and len(labels) == len(joint_names):
        robot_order = _sort_numerically(joint_names)
        places = list(range(len(joint_names))) if robot_order is None else robot_order
        order = [0] * len(labels)
        for label, joint in zip(counted, places, strict=True):
            order[joint] = label
        pairs = ", ".join(f"{labels[order[k]]} -> {joint_names[k]}" for k in range(len(order)))
        return order, (
            f"joint names of the log and of {robot} differ; they were matched by number: {pairs}",
        )
    if _are_named_in_order(labels, joint_names):
        pairs = ", ".join(map(" -> ".join, zip(labels, joint_names, strict=True)))
        return list(range(len(labels))), (
            f"joint names of the log and of {robot} differ; they were matched in their order, in"
            f" which they share words: {pairs}",
        )
    raise _make_misfit_error(labels, joint_names, source, robot)


SHARED = 0.5
"""Share of the joints that have a word in common with the label at their place, from which the
others are taken to be in the same order too."""


def _are_named_in_order(labels: Sequence[str], joint_names: Sequence[str]) -> bool:
    """Return whether words of labels and joints pair them in their order, and in no other.

    As `Rotation Pitch Elbow Wrist_Pitch Wrist_Roll Jaw` beside `shoulder_pan shoulder_lift
    elbow_flex wrist_flex wrist_roll gripper`. Names of a gripper count as alike.
    """
    if len(labels) != len(joint_names):
        return False
    own, wanted = ([_list_meanings(name) for name in names] for names in (labels, joint_names))
    shared = [[len(a & b) for b in wanted] for a in own]
    alike = [row[k] == max(row) for k, row in enumerate(shared)]
    paired = sum(row[k] > 0 for k, row in enumerate(shared))
    return all(alike) and paired >= SHARED * len(labels)


def _list_meanings(name: str) -> set[str]:
    words = {word for word in split_words(name) if word not in _GENERIC and not word.isdigit()}
    return words | ({"gripper"} if words & GRIPPERS else set())


def read_label_numbers(labels: Sequence[str]) -> list[int] | None:
    """Return the number that counts the labels, None if they differ in more than a number."""
    split = [split_words(label) for label in labels]
    if len({len(words) for words in split}) != 1 or len(labels) < 2:
        return None
    varying = [k for k in range(len(split[0])) if len({words[k] for words in split}) > 1]
    if len(varying) != 1 or not all(words[varying[0]].isdigit() for words in split):
        return None
    return [int(words[varying[0]]) for words in split]


def find_unlabelled_joints(
    labels: Sequence[str], joint_names: Sequence[str]
) -> tuple[str, ...] | None:
    """Return the joints that no label names; None unless the labels name some of the joints.

    At least half of the labels must name a joint each.

    >>> find_unlabelled_joints(["elbow", "wrist"], ["elbow_joint", "wrist_joint", "finger_joint"])
    ('finger_joint',)
    """
    for alike in _compare_names(labels, joint_names):
        named = alike.any(axis=0)
        clear = (alike.sum(axis=0) <= 1).all() and (alike.sum(axis=1) <= 1).all()
        if clear and named.any() and not named.all() and 2 * named.sum() >= len(labels):
            return tuple(compress(joint_names, np.logical_not(named).tolist()))
    return None


def _compare_names(labels: Sequence[str], joint_names: Sequence[str]) -> Iterator[Mask]:
    """Yield which labels (rows) are alike which joint names (columns), the closest likeness first.

    Likeness is of the whole, of words, and of words of meaning; each equal, then alike in the end.
    """
    ends_alike = _has_same_end if _are_numbered(labels, joint_names) else _has_same_named_end
    whole = [[(name,) for name in names] for names in (labels, joint_names)]
    words = [[tuple(split_words(name)) for name in names] for names in (labels, joint_names)]
    meanings = [
        [tuple(word for word in key if word not in _GENERIC) or key for key in keys]
        for keys in words
    ]
    for keys, wanted in (whole, words, meanings):
        for is_alike in (operator.eq, ends_alike):
            table = [[is_alike(key, want) for want in wanted] for key in keys]
            yield np.array(table, dtype=np.bool_).reshape(len(labels), len(joint_names))


def _has_same_end(key: tuple[str, ...], want: tuple[str, ...]) -> bool:
    return bool(key and want) and (key[-len(want) :] == want or want[-len(key) :] == key)


def _has_same_named_end(key: tuple[str, ...], want: tuple[str, ...]) -> bool:
    """Return whether names end alike in more than a number."""
    return _has_same_end(key, want) and not all(word.isdigit() for word in min(key, want, key=len))


def _are_numbered(labels: Sequence[str], joint_names: Sequence[str]) -> bool:
    """Return whether the names of both sides differ in a number alone, grippers aside."""
    return all(
        read_label_numbers([name for name in names if not names_gripper(name)]) is not None
        for names in (labels, joint_names)
    )


def _make_misfit_error(
    labels: Sequence[str], joint_names: Sequence[str], source: str, robot: str
) -> RecordingError:
    if len(labels) != len(joint_names):
        problem = f"{source} has {len(labels)} joints but {robot} has {len(joint_names)}"
    else:
        problem = f"the joint names of {source} do not fit {robot}"
    sheet = "give its joint names in column order in a recording sheet: joints = [...]"
    if read_label_numbers(labels) is None:
        sheet = (
            "give the robot's name of each joint of the log in a recording sheet: [joints] with"
            f' "{labels[0]}" = "..." and so on'
        )
    return RecordingError(
        f"{problem}. Joints of the log: {', '.join(labels)}. Joints of {robot}:"
        f" {', '.join(joint_names)}",
        cure=Cure(f"choose the robot that was recorded, or {sheet}"),
        file=source,
        value=list(labels),
        expected=list(joint_names),
        missing=find_unlabelled_joints(labels, joint_names),
    )


def _sort_numerically(labels: Sequence[str]) -> list[int] | None:
    """Return the order that sorts labels by their number, if they count from 0 or 1."""
    numbers = read_label_numbers(labels)
    if numbers is None or sorted(numbers) not in (
        list(range(len(labels))),
        list(range(1, len(labels) + 1)),
    ):
        return None
    return sorted(range(len(labels)), key=lambda k: numbers[k])


def _note_left_out(labels: Sequence[str], order: list[int], source: str) -> tuple[str, ...]:
    rest = [label for k, label in enumerate(labels) if k not in order]
    return (
        (f"joints of {source} that the robot does not have were left out: {', '.join(rest)}",)
        if rest
        else ()
    )
