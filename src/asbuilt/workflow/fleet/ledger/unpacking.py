"""The part of reading an entry that another process does, with as few imports as can be."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import polars as pl

from asbuilt.errors import ResultError
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.workflow.fleet.ledger.store import LARGEST


def unpacked(path: Path) -> LogTable:
    """Return the table of a Parquet file as one column, the bytes of an Arrow stream.

    `read_isolated` calls this, since decompression takes what memory it likes.
    """
    frame, stream = pl.read_parquet(path), io.BytesIO()
    if frame.estimated_size() > LARGEST:
        raise ResultError(f"it unpacks to more than {LARGEST / 1e6:.0f} MB")
    frame.write_ipc_stream(stream)
    content = stream.getvalue()
    padded = content + bytes(-len(content) % 8)
    return LogTable(source=str(path), columns={"arrow": np.frombuffer(padded)})
