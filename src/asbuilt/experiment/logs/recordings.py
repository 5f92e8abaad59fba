"""One way in for recordings: files, data frames, arrays, recordings, streams and samples."""

from __future__ import annotations

import filecmp
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.logs.formats.log_format import is_columns
from asbuilt.experiment.logs.long_recordings import RecordingStream, head_of, is_long
from asbuilt.experiment.logs.readers import (
    check_readable,
    find_sheet,
    group_files,
    read_recording,
)
from asbuilt.experiment.logs.reading_options import (
    OF_BASE,
    PathLike,
    ReadingOptions,
    merge_reading_options,
)
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.root import root_of
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure

Recorded = Recording | RecordingStream | Samples
RecordingLike = PathLike | Recorded | Mapping[str, Any] | Any
"""A file, a data frame of pandas or polars, a dict of arrays, or what is a recording already."""


def as_recordings(
    model: RobotModel | None,
    items: RecordingLike | Sequence[RecordingLike],
    options: ReadingOptions | None = None,
    *,
    streamed_from: float | None = None,
    **settings: Any,
) -> list[Recorded]:
    """Return recordings of whatever holds them; files too long for the memory become streams.

    Parameters
    ----------
    model
        Robot whose joints order the columns.
    items
        One or several of: a path, a data frame of pandas or polars, a dict of arrays, a
        `Recording`, a `RecordingStream`, `Samples`. Files of one quantity each whose names differ
        in that alone are one recording.
    options, **settings
        How files, frames and dicts are read: `ReadingOptions`, or single fields of it. Recordings,
        streams and samples stay as they are.
    streamed_from
        Size [bytes] beyond which a file becomes a stream; None: 200 MB.

    Returns
    -------
    list of Recording, RecordingStream or Samples
        In the order given.

    Raises
    ------
    RecordingError
        If an item is no recording or does not fit the robot.

    Examples
    --------
    >>> arrays = {"t": [0.0, 0.01], "q": [[0.0, 0.0], [0.1, 0.0]], "tau": [[1.0, 2.0], [3.0, 4.0]]}
    >>> [recording.n_joints for recording in as_recordings(None, [arrays, arrays])]
    [2, 2]
    """
    chosen = merge_reading_options(options, settings)
    listed = _list_items(items)
    groups = group_files([Path(item) for item in listed if isinstance(item, str | Path)])
    group_of = {path: group for group in groups for path in group}
    moves = model is not None and model.mixes_joints
    found: list[Recorded] = []
    for item in listed:
        source: Any = item
        if isinstance(item, str | Path):
            group = group_of[Path(item)]
            if group[0] != Path(item):
                continue  # read with the first file of its recording
            whole = len(group) > 1 or moves or not is_long(group[0], streamed_from)
            source = group if whole else RecordingStream(group[0], model, chosen)
        read = isinstance(source, Recorded)
        found.append(source if read else read_recording(source, model=model, options=chosen))
    return found


def read_fitted_recordings(
    model: RobotModel,
    groups: Sequence[RecordingLike | Sequence[RecordingLike]],
    options: ReadingOptions | None = None,
    *,
    streamed_from: float | None = None,
) -> tuple[RobotModel, list[list[Recorded]]]:
    """Return the robot as it was recorded, and its recordings, group by group.

    Joints that a recording lacks are locked, at 0 or in the middle of their limits; `lock` of the
    options and sheets gives others, and positions; one that is logged is locked at its median
    position. `gravity` of the options replaces the robot's. Feet whose radius is not stated
    get the radius on which they roll.

    Parameters
    ----------
    model
        Robot as described.
    groups
        Items as `as_recordings` takes them.
    options
        How files, frames and dicts are read.
    streamed_from
        Size [bytes] beyond which a file becomes a stream; None: 200 MB.

    Returns
    -------
    RobotModel, list of lists of recordings
        The robot without the joints that are locked, and recordings with the joints of the robot.

    Raises
    ------
    RecordingError
        If an item is no recording or does not fit the robot.
    UsageError
        If options say how to read what is read already, or two items hold the same samples.
    """
    chosen = options or ReadingOptions()
    if chosen.gravity is not None:
        model = model.with_gravity(np.asarray(chosen.gravity, dtype=np.float64))
    listed = [_list_items(items) for items in groups]
    _refuse_idle(chosen, [item for items in listed for item in items])
    asked = _list_locks([item for items in listed for item in items], chosen)
    while True:
        try:
            read = [
                as_recordings(model, items, chosen, streamed_from=streamed_from) for items in listed
            ]
            logged = [[_list_joints(item, model) for item in items] for items in read]
        except RecordingError as problem:
            missing = _name_joints_to_lock(problem, model, asked) or problem.fields.get("missing")
            if not missing:
                raise
            model = model.locked({name: asked.get(name) for name in missing})
            continue
        present = set(model.joint_names).intersection(*(each for group in logged for each in group))
        absent = [name for name in model.joint_names if name not in present]
        if not absent:
            break
        model = model.locked({name: asked.get(name) for name in absent})
    free = [name for name in asked if name in model.joint_names]
    first = next((item for items in read for item in items), None)
    values = {name: _find_held_position(first, name, asked[name]) for name in free}
    for name in asked.keys() - values.keys() - model.locked_joints.keys():
        values[name] = None
    whole = model
    model = model.locked({**asked, **values})
    if model is not whole or any(each != model.joint_names for group in logged for each in group):
        read = [[_select_joints(item, model.joint_names) for item in items] for items in read]
    refuse_same_recordings([item for items in read for item in items])
    whole_ones = [item for items in read for item in items if isinstance(item, Recording)]
    return root_of(model).settle(model, whole_ones), read


def refuse_same_recordings(items: Sequence[Recorded]) -> None:
    """Raise `UsageError` where two items hold the same samples, whatever their names are.

    Counted twice a log seems surer than it is, and it judges itself. Clocks may differ: positions
    and torques that agree to the last digit are no second recording.
    """
    for k, item in enumerate(items):
        other = next((each for each in items[:k] if _hold_the_same(item, each)), None)
        if other is not None:
            named = item.source == other.source
            what = "given twice" if named else f"the same samples as {other.source}"
            raise UsageError(
                f"{item.source} is {what}", cure=Cure("give every log once"), value=item.source
            )


def _hold_the_same(one: Recorded, other: Recorded) -> bool:
    """Return whether two items hold the same positions, torques and commands."""
    if one is other:
        return True
    if isinstance(one, RecordingStream) and isinstance(other, RecordingStream):
        return one.path.resolve() == other.path.resolve() or filecmp.cmp(
            one.path, other.path, shallow=False
        )
    if isinstance(one, RecordingStream) or type(one) is not type(other):
        return False
    pairs = [
        (getattr(one, name, None), getattr(other, name, None)) for name in ("q", "tau", "command")
    ]
    return all(
        a is b or (a is not None and b is not None and np.array_equal(a, b, equal_nan=True))
        for a, b in pairs
    )


OF_THE_ROBOT = ("lock", "gravity", *OF_BASE)
"""Options of reading that concern recordings which are read already, too."""


def _refuse_idle(options: ReadingOptions, items: Sequence[Any]) -> None:
    """Raise if options say how to read, and a recording is read already."""
    given = [
        entry.name
        for entry in fields(options)
        if entry.name not in OF_THE_ROBOT and getattr(options, entry.name) != entry.default
    ]
    read = [item for item in items if isinstance(item, Recorded)]
    if given and read:
        raise UsageError(
            f"{read[0].source} is read already, so that {', '.join(given)} would have no effect",
            cure=Cure("give its path, or these options where it is read", call="read_recording"),
            value=given,
        )


def _list_locks(items: Sequence[Any], options: ReadingOptions) -> dict[str, float | None]:
    """Return the joints to lock of the sheets and, in their place, of the options."""
    found: dict[str, float | None] = {}
    for item in items:
        if isinstance(item, str | Path):
            check_readable(Path(item))
            found |= find_sheet(Path(item), options.sheet)[0].lock
    lock = options.lock
    return found | (dict(lock) if isinstance(lock, Mapping) else {})


def _name_joints_to_lock(
    problem: RecordingError, model: RobotModel, asked: Mapping[str, float | None]
) -> tuple[str, ...]:
    """Return the joints to lock if the log, which counts its joints, has all others."""
    named = tuple(name for name in model.joint_names if name in asked)
    labels = problem.fields.get("value")
    count = len(labels) if isinstance(labels, list) else labels
    fits = problem.fields.get("expected") in (model.n_joints, list(model.joint_names))
    return named if fits and count == model.n_joints - len(named) else ()


def _list_joints(item: Recorded, model: RobotModel) -> tuple[str, ...]:
    """Return the joints that a recording has; the robot's, where its names match none."""
    names = (item if isinstance(item, Samples) else head_of(item)).joint_names
    return names if set(names) & set(model.joint_names) else model.joint_names


def _find_held_position(item: Recorded | None, joint: str, value: float | None) -> float | None:
    """Return the position given, or the median of a recording that has the joint."""
    if value is not None or item is None:
        return value
    head = item.head if isinstance(item, RecordingStream) else item
    if joint not in head.joint_names:
        return None
    return float(np.nanmedian(head.q[:, head.joint_names.index(joint)]))


def _select_joints(item: Recorded, joints: tuple[str, ...]) -> Recorded:
    if isinstance(item, RecordingStream):
        return replace(item, joints=joints)
    if isinstance(item, Recording) and set(joints) <= set(item.joint_names):
        return item.reordered(joints)
    return item


def _list_items(items: Any) -> list[Any]:
    if isinstance(items, str | Path | Recorded) or is_columns(items):
        return [items]
    listed = list(items)
    nameless = next((item for item in listed if isinstance(item, np.ndarray | float | int)), None)
    if nameless is not None:
        shape = "" if not isinstance(nameless, np.ndarray) else f" of shape {nameless.shape}"
        raise UsageError(
            f"a recording holds an array{shape} that has no name",
            cure=Cure("name them: {'t': t, 'q': q, 'tau': tau}, joints side by side"),
        )
    return listed
