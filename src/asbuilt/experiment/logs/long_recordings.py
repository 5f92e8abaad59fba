"""Recordings too long for the memory: read in chunks, thinned while they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.assembly import apply_sheet, build_recording
from asbuilt.experiment.logs.columns.layout import QUANTITIES
from asbuilt.experiment.logs.formats.log_format import choose_log_format
from asbuilt.experiment.logs.mending import LogMender
from asbuilt.experiment.logs.readers import (
    check_readable,
    find_sheet,
    find_table_layout,
    read_recording,
)
from asbuilt.experiment.logs.reading_options import PathLike, ReadingOptions, merge_reading_options
from asbuilt.experiment.logs.sheet import SheetFiles
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.experiment.signal.signal_chain import SignalChain


def stream_recording(
    path: PathLike,
    *,
    model: RobotModel | None = None,
    options: ReadingOptions | None = None,
    chunk_samples: int = 200_000,
    **settings: Any,
) -> Iterator[Recording]:
    """Read a recording in consecutive chunks.

    Parquet and delimited text are read lazily, so memory depends on the chunk, not on the length;
    other formats are read whole first. Extra quantities are left out.

    Parameters
    ----------
    path
        The log.
    chunk_samples
        Samples per chunk; the last chunk may be shorter.
    model, options, **settings
        As of `read_recording`.

    Raises
    ------
    RecordingError
        As `read_recording`; a bad cell is reported when its chunk is reached.
    """
    if chunk_samples < 1:
        raise RecordingError(
            f"chunk_samples must be at least 1, got {chunk_samples}", value=chunk_samples, lower=1
        )
    path = Path(path)
    chosen = merge_reading_options(options, settings)
    check_readable(path)
    sheet, notes = find_sheet(path, chosen.sheet)
    sheet = chosen.with_windows(sheet)
    whole_first = sheet.files != SheetFiles() or sheet.sign == "command"
    stream = None
    if not whole_first and path.suffix != ".toml":
        stream = choose_log_format(path).stream(path, sheet)
    if stream is None:
        whole = read_recording(path, model=model, options=replace(chosen, sheet=sheet))
        for begin in range(0, whole.n_samples, chunk_samples):
            yield whole.taken(slice(begin, begin + chunk_samples))
        return
    try:
        layout = find_table_layout(stream.header, sheet, model, chosen)
        lacks_values = layout.by_values
    except RecordingError:
        # By the first rows of all numeric columns an error drafts a sheet.
        lacks_values = True
    if lacks_values:
        layout = find_table_layout(stream.read_first(CHUNK), sheet, model, chosen)
    quantities = {name: layout.quantities[name] for name in QUANTITIES if name in layout.quantities}
    layout = replace(layout, quantities=quantities)
    rate = chosen.rate if chosen.rate is not None else sheet.rate
    origin: float | None = None
    start: float | None = None
    mender = LogMender(layout, sheet.zero)
    for first, columns in stream.chunks(layout.columns, chunk_samples):
        table = mender.mend(replace(stream.header, columns=columns))
        if not table.n_samples:
            continue
        chunk = build_recording(table, layout, rate=rate, first_sample=first, origin=origin)
        chunk = apply_sheet(
            replace(chunk, notes=(*notes, *table.notes, *chunk.notes)), sheet, chosen
        )
        origin = chunk.started
        start = float(chunk.t[0]) if start is None else start
        inside = sheet.in_windows(chunk.t, start)
        if inside.any():
            yield chunk if inside.all() else chunk.taken(inside)


LONG = 200e6
"""Size [bytes] from which a recording is read in chunks."""
CHUNK = 30_000
"""Samples read at once."""
HEAD = 60_000
"""Samples at the beginning by which a recording is checked and its filters are chosen."""
GROWTH = 60_000
"""Samples by which the memory of the filtered samples grows, in place."""
COLUMNS = ("t", "q", "qd", "qdd", "tau", "tau_raw")


@dataclass(frozen=True, eq=False)
class RecordingStream:
    """Name a recording that is read in chunks whenever it is iterated.

    Parameters
    ----------
    path
        The log.
    model
        Robot whose joints order the columns.
    options
        How to read it.
    chunk_samples
        Samples per chunk.
    joints
        Joints to keep, in order; None: the robot's.
    change
        What is made of each chunk, such as another torque; None: nothing.

    Examples
    --------
    >>> RecordingStream(Path("hour.parquet"), options=ReadingOptions(rate=1000.0)).source
    'hour.parquet'
    """

    path: Path
    model: RobotModel | None = field(default=None, repr=False)
    options: ReadingOptions = field(default_factory=ReadingOptions)
    chunk_samples: int = CHUNK
    joints: tuple[str, ...] | None = None
    change: Callable[[Recording], Recording] | None = field(default=None, repr=False)

    @property
    def source(self) -> str:
        """Name of the log."""
        return str(self.path)

    def __iter__(self) -> Iterator[Recording]:
        """Yield its chunks in order."""
        return self._read(self.chunk_samples)

    def _read(self, chunk_samples: int) -> Iterator[Recording]:
        for chunk in stream_recording(
            self.path, model=self.model, options=self.options, chunk_samples=chunk_samples
        ):
            kept = chunk if self.joints is None else chunk.reordered(self.joints)
            yield kept if self.change is None else self.change(kept)

    @cached_property
    def head(self) -> Recording:
        """The beginning, by which the recording is checked and its filters are chosen.

        Raises
        ------
        RecordingError
            If it holds no samples.
        """
        return self.beginning(HEAD)

    def beginning(self, n_samples: int) -> Recording:
        """Return the first samples, at most so many.

        Raises
        ------
        RecordingError
            If it holds no samples.
        """
        for recording in self._read(n_samples):
            return recording
        raise RecordingError(
            f"{self.path} is not a recording: it holds no samples", file=self.source
        )

    def prepared(self, chain: SignalChain) -> Samples:
        """Return its samples after filtering and thinning, about 100 MB per hour and 7 joints."""
        from asbuilt.experiment.signal.preparation import (  # noqa: PLC0415 - light start
            stream_samples,
        )
        from asbuilt.experiment.signal.samples import Samples  # noqa: PLC0415 - light start

        columns: dict[str, Array] = {}
        bounds = [0]
        first = None
        for samples in stream_samples(self, chain):
            first = first or samples
            filled = bounds[-1]
            for name in COLUMNS:
                part = getattr(samples, name)
                held = columns.setdefault(name, np.empty((GROWTH, *part.shape[1:])))
                if filled + len(part) > len(held):
                    held.resize((filled + len(part) + GROWTH, *part.shape[1:]), refcheck=False)
                held[filled : filled + len(part)] = part
            bounds += [filled + stop for _, stop in samples.segments]
        if first is None:
            raise RecordingError(
                f"{self.path}: no samples are left after filtering",
                cure=Cure("raise the cutoff, record longer, or check that the robot moves"),
                file=self.source,
            )
        note = (
            f"read in chunks of {self.chunk_samples} samples; checked and its filters chosen on"
            f" the first {HEAD}"
        )
        return Samples(
            **cast(Any, {name: held[: bounds[-1]] for name, held in columns.items()}),
            rate=first.rate,
            joint_names=first.joint_names,
            segments=tuple(pairwise(bounds)),
            source=self.source,
            torque_source=first.torque_source,
            parallel=first.parallel,
            origin=first.origin,
            provenance=(*first.provenance, note),
            delay=first.delay,
            slowest=first.slowest,
            clock_bound=first.clock_bound,
        )


def head_of(recording: Recording | RecordingStream) -> Recording:
    """Return a recording in memory, or the beginning of a stream."""
    return recording.head if isinstance(recording, RecordingStream) else recording


def take_first_samples(recording: Recording | RecordingStream, n_samples: int) -> Recording:
    """Return the first samples of a recording or a stream, at most so many."""
    if isinstance(recording, RecordingStream):
        return recording.beginning(n_samples)
    return recording if recording.n_samples <= n_samples else recording.taken(slice(n_samples))


def is_long(path: Path, size: float | None = None) -> bool:
    """Return whether a file can be read in chunks and takes more memory than `size` [bytes].

    None is `LONG`.
    """
    if not path.is_file() or path.suffix == ".toml":
        return False
    n_bytes = choose_log_format(path).n_bytes
    return n_bytes is not None and n_bytes(path) > (LONG if size is None else size)
