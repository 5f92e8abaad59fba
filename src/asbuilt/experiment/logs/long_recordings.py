"""Recordings too long to be held as logged.

Opened, read stretch by stretch, and thinned while they are read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Unpack

import numpy as np
import polars as pl

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.parquet import scan_parquet
from asbuilt.experiment.logs.readers import (
    TEXT_SUFFIXES,
    PathLike,
    ReadingOptions,
    grouped_files,
    read_recording,
)
from asbuilt.experiment.logs.streaming import stream_recording
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.signal.signal_chain import SignalChain, prepare_samples, stream_samples

LONG = 200e6
"""Size [bytes] of the numbers in a Parquet file, or of a text file, from which a recording is read
in stretches.
"""
CHUNK = 30_000
"""Samples read at once."""
HEAD = 60_000
"""Samples at the beginning by which a recording is checked and its filters are chosen."""
GROWTH = 60_000
"""Samples by which the memory for what the filters leave grows, in place."""
COLUMNS = ("t", "q", "qd", "qdd", "tau", "tau_raw")


@dataclass(frozen=True, eq=False)
class RecordingStream:
    """Name a recording that is read in stretches, as often as it is gone through.

    >>> stream = RecordingStream(Path("hour.parquet"), {"rate": 1000.0})
    >>> stream.source
    'hour.parquet'
    """

    path: Path
    options: ReadingOptions = field(default_factory=ReadingOptions)
    chunk_samples: int = CHUNK

    @property
    def source(self) -> str:
        """Where it is."""
        return str(self.path)

    def __iter__(self) -> Iterator[Recording]:
        """Yield its stretches in order."""
        return self._read(self.chunk_samples)

    def _read(self, chunk_samples: int) -> Iterator[Recording]:
        return stream_recording(self.path, chunk_samples=chunk_samples, **self.options)

    @cached_property
    def head(self) -> Recording:
        """The beginning, by which the recording is checked and its filters are chosen.

        Raises `RecordingError` where there is none.
        """
        for recording in self._read(HEAD):
            return recording
        raise RecordingError(f"{self.path} is not a recording: it holds no samples")

    def prepared(self, chain: SignalChain) -> Samples:
        """Return its samples after filtering and thinning.

        Only these are held, about 100 MB for an hour of seven joints.
        """
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
                f"{self.path}: nothing is left after filtering; raise the cutoff, record longer, or"
                " check that the robot moves"
            )
        return Samples(
            **{name: held[: bounds[-1]] for name, held in columns.items()},
            rate=first.rate,
            joint_names=first.joint_names,
            segments=tuple(pairwise(bounds)),
            source=self.source,
            torque_source=first.torque_source,
            parallel=first.parallel,
            origin=first.origin,
            provenance=(
                *first.provenance,
                (
                    f"read in stretches of {self.chunk_samples} samples; checked and its filters"
                    f" chosen on the first {HEAD}"
                ),
            ),
        )


def head_of(recording: Recording | RecordingStream) -> Recording:
    """Return what a recording is checked by and its filters are chosen by.

    Itself, or the beginning of a stream.
    """
    return recording.head if isinstance(recording, RecordingStream) else recording


def prepare_logged(recording: Recording | RecordingStream, chain: SignalChain) -> Samples:
    """Return the samples of a recording, held or not, after the signal chain, whose open choices
    are made for it.
    """
    if isinstance(recording, RecordingStream):
        return recording.prepared(chain.resolved(recording.head))
    return prepare_samples(recording, chain)


def is_long(path: Path) -> bool:
    """Return whether a file should be read in stretches, from its size alone."""
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in {".parquet", *TEXT_SUFFIXES}:
        return False
    if suffix == ".parquet":
        frame, names, _ = scan_parquet(path)
        return int(frame.select(pl.len()).collect().item()) * len(names) * 8 > LONG
    return path.stat().st_size > LONG


def open_recordings(
    paths: Sequence[PathLike], **options: Unpack[ReadingOptions]
) -> list[Recording | RecordingStream]:
    """Read recordings as `read_recordings` does, but leave those too long to be held as streams."""
    groups = grouped_files([Path(path) for path in paths])
    return [
        (
            RecordingStream(group[0], options)
            if len(group) == 1 and is_long(group[0])
            else read_recording(group, **options)
        )
        for group in groups
    ]
