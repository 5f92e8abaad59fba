"""Recordings in MATLAB files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.hdf5 import read_hdf5
from asbuilt.experiment.logs.formats.isolated import read_isolated
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogTable,
    table_from_variables,
)


def read_mat(path: Path) -> LogTable:
    """Read numeric variables of a `.mat` file, also inside structures.

    Version 7.3 files are read as HDF5.

    Raises
    ------
    RecordingError
        If the file is no MATLAB file or holds no numbers.
    """
    with path.open("rb") as file:
        start = file.read(128)
    if start.startswith(b"MATLAB 7.3") or start[1:4] == b"HDF":
        return read_hdf5(path)
    from scipy.io import loadmat  # noqa: PLC0415 - light start
    from scipy.io.matlab import MatReadError  # noqa: PLC0415 - light start

    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except (
        MatReadError, ValueError, OSError, TypeError, NotImplementedError, IndexError
    ) as error:  # fmt: skip
        raise RecordingError(
            f"{path} is not a recording: it cannot be read as a MATLAB file ({error})",
            file=str(path),
        ) from error
    variables: dict[str, Array] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _collect(name, value, variables)
    return table_from_variables(str(path), variables)


def _collect(name: str, value: Any, variables: dict[str, Array]) -> None:
    if hasattr(value, "_fieldnames"):
        for field in value._fieldnames:
            _collect(
                field if field not in variables else f"{name}.{field}",
                getattr(value, field),
                variables,
            )
    elif isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.number):
        variables[name] = value


FORMATS.register(
    "matlab",
    LogFormat(suffixes=(".mat",), read=lambda path, sheet: read_isolated(read_mat, path)),
)
