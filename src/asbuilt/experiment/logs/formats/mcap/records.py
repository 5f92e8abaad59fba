"""Channels and messages of an MCAP file, in the order written, without its index."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from asbuilt.errors import MissingExtraError, RecordingError

MOST = 1 << 30
"""Bytes of a single record, compressed or not; chunks are a few MB."""


@dataclass(frozen=True, slots=True)
class Channel:
    """Hold the topic of messages, how they are encoded, and the name of their schema."""

    topic: str
    encoding: str
    schema: str


class McapRecords:
    """Read a file record by record; `channels` fills on the way, `complete` says how it ended."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.complete = False

    def messages(self) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, time of logging [ns] and content of every message.

        Raises
        ------
        RecordingError
            If the file is no MCAP file, or a record is damaged.
        MissingExtraError
            If mcap is not installed.
        """
        try:
            from mcap import exceptions, records  # noqa: PLC0415
        except ImportError as error:
            raise MissingExtraError("mcap", "bags", f"reading {self.path}") from error
        schemas: dict[int, str] = {}
        with self.path.open("rb") as file:
            try:
                for record in self._records(file):
                    if isinstance(record, records.Schema):
                        schemas[record.id] = record.name
                    elif isinstance(record, records.Channel):
                        schema = schemas.get(record.schema_id, "")
                        self.channels[record.id] = Channel(
                            record.topic, record.message_encoding, schema
                        )
                    elif isinstance(record, records.Message) and record.channel_id in self.channels:
                        yield self.channels[record.channel_id], record.log_time, record.data
            except RecordingError:
                raise
            except (exceptions.EndOfFile, struct.error) as error:
                # A record ends early where the file does: a recorder that was switched off.
                if file.read(1) or not self.channels:
                    raise self._damaged(f"{type(error).__name__}: {error}") from None
            except Exception as error:  # lz4 and zstandard raise exceptions of their own
                raise self._damaged(f"{type(error).__name__}: {error}") from error

    def _records(self, file: BinaryIO) -> Iterator[Any]:
        """Yield records, those of chunks in their place, until the end of the data."""
        from mcap.records import Chunk, DataEnd  # noqa: PLC0415
        from mcap.stream_reader import StreamReader, breakup_chunk  # noqa: PLC0415

        for record in StreamReader(file, emit_chunks=True, record_size_limit=MOST).records:
            if isinstance(record, DataEnd):
                self.complete = True
                return
            if not isinstance(record, Chunk):
                yield record
                continue
            if record.uncompressed_size > MOST:
                raise self._damaged(f"a chunk unpacks to {record.uncompressed_size} bytes")
            if record.compression not in ("", "lz4", "zstd"):
                raise self._damaged(
                    f"chunks are compressed as {record.compression!r}; known are lz4 and zstd"
                )
            yield from breakup_chunk(record, validate_crc=True)

    def _damaged(self, why: str) -> RecordingError:
        return RecordingError(
            f"{self.path} is not a recording: it cannot be read as MCAP ({why})",
            file=str(self.path),
        )
