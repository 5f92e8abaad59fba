"""Channels and messages of an MCAP file, in the order written, without its index.

A file is a magic number and records: opcode (1 byte), length (8 bytes), content. Chunks hold
further records, compressed (format: mcap.dev/spec, version 0).
"""

from __future__ import annotations

import io
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from asbuilt.errors import MissingExtraError, RecordingError

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
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
        self._schemas: dict[int, str] = {}

    def messages(self) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, time of logging [ns] and content of every message.

        Raises
        ------
        RecordingError
            If the file is no MCAP file, or a record is damaged.
        MissingExtraError
            If what unpacks its chunks is not installed.
        """
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise self._damaged("it does not begin as an MCAP file")
            for opcode, content in self._records(file):
                if opcode == CHUNK:
                    for inner, part in self._records(io.BytesIO(self._unpacked(content))):
                        yield from self._message(inner, part)
                else:
                    yield from self._message(opcode, content)

    def _records(self, file: BinaryIO) -> Iterator[tuple[int, bytes]]:
        """Yield records until the data end; one that is cut off ends the file."""
        while len(head := file.read(9)) == 9:
            opcode, size = struct.unpack("<BQ", head)
            if opcode == DATA_END:
                self.complete = True
                return
            if size > MOST:
                raise self._damaged(f"a record has {size} bytes")
            content = file.read(size)
            if len(content) < size:
                return
            yield opcode, content

    def _message(self, opcode: int, content: bytes) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield a message; schemas and channels are kept."""
        try:
            if opcode == SCHEMA:
                name, _ = _text(content, 2)
                self._schemas[struct.unpack_from("<H", content)[0]] = name
            elif opcode == CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                topic, after = _text(content, 4)
                encoding, _ = _text(content, after)
                self.channels[number] = Channel(topic, encoding, self._schemas.get(schema, ""))
            elif opcode == MESSAGE:
                number, _, stamp, _ = struct.unpack_from("<HIQQ", content)
                if number in self.channels:
                    yield self.channels[number], stamp, content[22:]
        except (struct.error, UnicodeDecodeError) as error:
            raise self._damaged(f"{type(error).__name__}: {error}") from None

    def _unpacked(self, chunk: bytes) -> bytes:
        """Return the records of a chunk."""
        try:
            (size,) = struct.unpack_from("<Q", chunk, 16)
            kind, after = _text(chunk, 28)
        except (struct.error, UnicodeDecodeError) as error:
            raise self._damaged(f"{type(error).__name__}: {error}") from None
        packed = chunk[after + 8 :]
        if size > MOST:
            raise self._damaged(f"a chunk unpacks to {size} bytes")
        if not kind:
            return packed
        unpack = self._unpacker(kind)
        try:
            return unpack(packed)
        except (RuntimeError, ValueError, OSError, EOFError) as error:
            raise self._damaged(f"a chunk does not unpack ({error})") from None
        except Exception as error:  # zstd raises an exception of its own
            raise self._damaged(f"a chunk does not unpack ({error})") from error

    def _unpacker(self, kind: str) -> Callable[[bytes], bytes]:
        newer = sys.version_info >= (3, 14)
        modules = {"lz4": "lz4.frame", "zstd": "compression.zstd" if newer else "backports.zstd"}
        if kind not in modules:
            raise self._damaged(f"chunks are compressed as {kind!r}; known are lz4 and zstd")
        try:
            module: Any = import_module(modules[kind])
        except ImportError as error:
            raise MissingExtraError(kind, "bags", f"reading {self.path}") from error
        unpack: Callable[[bytes], bytes] = module.decompress
        return unpack

    def _damaged(self, why: str) -> RecordingError:
        return RecordingError(
            f"{self.path} is not a recording: it cannot be read as MCAP ({why})",
            file=str(self.path),
        )


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Return the text at a place, and the place after it."""
    (size,) = struct.unpack_from("<I", content, at)
    if len(content) < at + 4 + size:
        raise struct.error(f"a text of {size} bytes is cut off")
    return content[at + 4 : at + 4 + size].decode(), at + 4 + size
