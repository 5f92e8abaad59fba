"""One way in for recordings: files, data frames, arrays, recordings, streams and samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from asbuilt.description.model import RobotModel
from asbuilt.experiment.logs.formats.frames import is_columns
from asbuilt.experiment.logs.long_recordings import RecordingStream, is_long
from asbuilt.experiment.logs.options import PathLike, ReadingOptions, reading_options
from asbuilt.experiment.logs.readers import grouped_files, read_recording
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples

Recorded = Recording | RecordingStream | Samples
RecordingLike = PathLike | Recorded | Mapping[str, Any] | Any
"""A file, a data frame of pandas or polars, a dict of arrays, or what is a recording already."""


def as_recordings(
    model: RobotModel | None,
    items: RecordingLike | Sequence[RecordingLike],
    options: ReadingOptions | None = None,
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
    chosen = reading_options(options, settings)
    listed = _listed(items)
    groups = grouped_files([Path(item) for item in listed if isinstance(item, str | Path)])
    group_of = {path: group for group in groups for path in group}
    found: list[Recorded] = []
    for item in listed:
        if isinstance(item, str | Path):
            group = group_of[Path(item)]
            if group[0] == Path(item):
                found.append(_of_files(group, model, chosen))
        elif isinstance(item, Recorded):
            found.append(item)
        else:
            found.append(read_recording(item, model=model, options=chosen))
    return found


def _listed(items: Any) -> list[Any]:
    one = isinstance(items, str | Path | Recorded) or is_columns(items)
    return [items] if one else list(items)


def _of_files(
    group: list[Path], model: RobotModel | None, options: ReadingOptions
) -> Recording | RecordingStream:
    if len(group) == 1 and is_long(group[0]):
        return RecordingStream(group[0], model, options)
    return read_recording(group, model=model, options=options)
