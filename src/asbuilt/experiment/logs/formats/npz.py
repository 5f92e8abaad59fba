"""Recordings in NumPy archives."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.table import Table, table_from_variables


def read_npz(path: Path) -> Table:
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
                f"{path} holds one array of shape {archive.shape} without names; save named arrays:"
                " np.savez(path, t=t, q=q, tau=tau)"
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
            f"{path} is not a recording: NumPy cannot read it as an .npz archive; save named arrays"
            " with np.savez(path, t=t, q=q, tau=tau)"
        ) from error
    if not variables:
        reason = (
            f"its arrays are pickled objects ({', '.join(pickled)}), which are not read for safety"
            if pickled
            else "it holds no array"
        )
        raise RecordingError(
            f"{path} is not a recording: {reason}; save plain number arrays with np.savez(path,"
            " t=t, q=q, tau=tau)"
        )
    return table_from_variables(str(path), variables)
