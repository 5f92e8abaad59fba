"""Recordings too long for the memory: read in chunks, thinned while they are read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.errors import RecordingError
from asbuilt.experiment.command.servo_torque import driven_by_command
from asbuilt.experiment.logs.formats.log_format import log_format
from asbuilt.experiment.logs.options import ReadingOptions
from asbuilt.experiment.logs.streaming import stream_recording
from asbuilt.experiment.recording import Recording
from asbuilt.findings import Cure

if TYPE_CHECKING:
    from asbuilt.experiment.signal.samples import Samples
    from asbuilt.experiment.signal.signal_chain import SignalChain

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
        Joints to keep, in order; None: those of the robot.
    servo
        The position servo whose torque each chunk gets; None: as stated.

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
    servo: PositionServo | None = None

    @property
    def source(self) -> str:
        """Name of the log."""
        return str(self.path)

    def __iter__(self) -> Iterator[Recording]:
        """Yield its chunks in order."""
        return self._read(self.chunk_samples)

    def _read(self, chunk_samples: int) -> Iterator[Recording]:
        chunks = stream_recording(
            self.path, model=self.model, options=self.options, chunk_samples=chunk_samples
        )
        joints = self.joints
        kept = chunks if joints is None else (chunk.reordered(joints) for chunk in chunks)
        servo = self.servo
        return kept if servo is None else (driven_by_command(chunk, servo) for chunk in kept)

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
        bounds, first = [0], None
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


def first_of(recording: Recording | RecordingStream, n_samples: int) -> Recording:
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
    stream = log_format(path).stream
    return stream is not None and stream.n_bytes(path) > (LONG if size is None else size)
