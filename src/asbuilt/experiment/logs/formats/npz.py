"""Recordings in NumPy archives."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.isolated import LIMITS, read_isolated
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogTable,
    table_from_variables,
)
from asbuilt.findings import Cure
from asbuilt.untrusted import reason

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
        _refuse_bombs(path)
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
                except ValueError as error:
                    if "pickle" not in str(error):
                        raise
                    pickled.append(name)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(
            f"{path} is not a recording: NumPy cannot read it as an .npz archive ({reason(error)})",
            cure=_SAVE,
            file=str(path),
        ) from error
    if not variables:
        why = (
            f"its arrays are pickled objects ({', '.join(pickled)}), which are not read for safety"
            if pickled
            else "it holds no array"
        )
        raise RecordingError(f"{path} is not a recording: {why}", cure=_SAVE, file=str(path))
    return table_from_variables(str(path), variables)


def _refuse_bombs(path: Path) -> None:
    """Raise `RecordingError` if an archive declares more than it may hold."""
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        declared = sum(member.file_size for member in archive.infolist())
    most = LIMITS.memory_for(path.stat().st_size)
    if declared > most:
        raise RecordingError(
            f"{path} declares {declared / 1e9:.3g} GB of arrays; at most {most / 1e9:.3g} GB are"
            " read from a file of its size",
            cure=Cure("save it without compression, or as Parquet, which is read in chunks"),
            file=str(path),
        )


FORMATS.register(
    "npz",
    LogFormat(suffixes=(".npz",), read=lambda path, sheet: read_isolated(read_npz, path)),
)
