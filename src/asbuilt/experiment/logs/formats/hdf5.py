"""Recordings in HDF5 and MATLAB files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import MissingExtraError, RecordingError
from asbuilt.experiment.logs.formats.isolated import LIMITS, read_isolated
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogTable,
    table_from_variables,
)
from asbuilt.findings import Cure


def read_hdf5(path: Path) -> LogTable:
    """Read every numeric dataset of an HDF5 file (also MATLAB 7.3).

    Groups are searched, and a name is the last part of its path where that is unique.

    Raises
    ------
    MissingExtraError
        If h5py is not installed.
    RecordingError
        If the file is no HDF5 file or holds no numbers.
    """
    try:
        import h5py  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError("h5py", "hdf5", f"reading {path}") from error
    variables: dict[str, Array] = {}

    def refuse_link(name: str, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            raise _foreign(path, name, f"links to the file {link.filename!r}")

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        if item.is_virtual or item.external:
            raise _foreign(path, name, "takes its values from other files")
        if item.size and item.size * item.dtype.itemsize > LIMITS.memory_for(path.stat().st_size):
            raise RecordingError(
                f"{path}: the dataset {name!r} declares {item.size * item.dtype.itemsize:.3g}"
                " bytes, too many for a file of its size",
                file=str(path),
            )
        if item.dtype.names:
            for field in item.dtype.names:
                if np.issubdtype(item.dtype[field], np.number):
                    variables[f"{name}/{field}"] = item[field]
        elif np.issubdtype(item.dtype, np.number):
            variables[name] = item[()]

    try:
        with h5py.File(path, "r") as file:
            file.visititems_links(refuse_link)
            file.visititems(visit)
    except OSError as error:
        raise RecordingError(
            f"{path} is not a recording: it cannot be read as HDF5 ({error})", file=str(path)
        ) from error
    short = [name.rsplit("/", 1)[-1] for name in variables]
    named = {
        last if short.count(last) == 1 else name: value
        for (name, value), last in zip(variables.items(), short, strict=True)
    }
    return table_from_variables(str(path), named)


def _foreign(path: Path, name: str, why: str) -> RecordingError:
    return RecordingError(
        f"{path}: {name!r} {why}, which is refused",
        cure=Cure("copy the values into one file, such as with h5repack"),
        file=str(path),
    )


FORMATS.register(
    "hdf5",
    LogFormat(suffixes=(".h5", ".hdf5"), read=lambda path, sheet: read_isolated(read_hdf5, path)),
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
