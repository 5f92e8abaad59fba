"""Recordings in memory: data frames and dicts of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable, tabulate_variables


def is_columns(item: Any) -> bool:
    """Return whether an object is a dict of arrays or a data frame of pandas or polars."""
    return isinstance(item, Mapping) or (hasattr(item, "columns") and hasattr(item, "__getitem__"))


def tabulate_columns(item: Any) -> LogTable:
    """Return the columns of a dict of arrays (vectors or matrices) or of a data frame.

    A named index of a pandas frame counts as a column; time stamps become seconds.

    Raises
    ------
    RecordingError
        If no column is numeric.
    """
    if isinstance(item, Mapping):
        arrays = {str(name): np.asarray(values) for name, values in item.items()}
        return tabulate_variables("dict of arrays", arrays)
    frame = item
    if getattr(getattr(item, "index", None), "name", None) is not None:
        frame = item.reset_index()
    found = {str(name): np.asarray(frame[name].to_numpy()) for name in frame.columns}
    columns = {
        name: values
        for name, each in found.items()
        if (values := _convert_to_numbers(each)) is not None
    }
    if not columns:
        raise RecordingError(
            "the data frame is not a recording: none of its columns is numeric"
            f" ({', '.join(found)})"
        )
    text = tuple(name for name in found if name not in columns)
    return LogTable(source="data frame", columns=columns, text_columns=text, order=tuple(found))


def _convert_to_numbers(values: Array) -> Array | None:
    """Return a column as floats, time stamps in seconds; None if it does not hold numbers."""
    if values.dtype.kind in "mM":
        return values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64).astype(np.float64) / 1e9
    if values.dtype.kind not in "biuf":
        return None
    return values.astype(np.float64)
