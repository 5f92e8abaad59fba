"""Recordings in NumPy archives."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogTable,
    table_from_variables,
)
from asbuilt.findings import Cure

_SAVE = Cure("save named arrays of numbers: np.savez(path, t=t, q=q, tau=tau)")


def read_npz(path: Path) -> LogTable:
    """Read the arrays of an `.npz` archive; pickled objects are refused, not executed.

    Raises
    ------
    RecordingError
        If the file is no archive of arrays, or holds nothing that looks like a recording.
    """
    variables = {}
    pickled = []
    try:
        archive = np.load(path, allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise RecordingError(
                f"{path} holds one array of shape {archive.shape} without names",
                cure=_SAVE,
                file=str(path),
            )
        with archive:
            for name in archive.files:
                try:
                    variables[name] = archive[name]
                except ValueError:
                    pickled.append(name)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(
            f"{path} is not a recording: NumPy cannot read it as an .npz archive",
            cure=_SAVE,
            file=str(path),
        ) from error
    if not variables:
        reason = (
            f"its arrays are pickled objects ({', '.join(pickled)}), which are not read for safety"
            if pickled
            else "it holds no array"
        )
        raise RecordingError(f"{path} is not a recording: {reason}", cure=_SAVE, file=str(path))
    return table_from_variables(str(path), variables)


FORMATS.register("npz", LogFormat(suffixes=(".npz",), read=lambda path, sheet: read_npz(path)))
