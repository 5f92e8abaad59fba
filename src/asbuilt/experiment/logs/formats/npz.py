"""Recordings in NumPy archives."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from asbuilt.arrays import Array
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


DTYPES = {
    "FloatStorage": "f4",
    "DoubleStorage": "f8",
    "HalfStorage": "f2",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
"""Storages of PyTorch and their NumPy types."""
SAVE = Cure("save a dict of tensors: torch.save({'time': t, 'dof_pos': q, 'des_dof_pos': u}, path)")


def read_torch_archive(path: Path) -> LogTable:
    """Read the tensors of a `.pt` file: a dict of vectors and matrices, such as PACE writes.

    Nested dicts give names joined by an underscore.

    Raises
    ------
    RecordingError
        If the file is no archive of tensors, or holds objects other than tensors, numbers and
        texts, which are not read for safety.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            declared = sum(member.file_size for member in archive.infolist())
            if declared > LIMITS.memory_for(path.stat().st_size):
                raise RecordingError(
                    f"{path} declares {declared / 1e9:.3g} GB of tensors", file=str(path)
                )
            content = _Content(archive).load()
    except RecordingError:
        raise
    except Exception as error:  # a damaged pickle raises what it likes
        raise RecordingError(
            f"{path} is not a recording: it is no archive of tensors that torch.save wrote"
            f" ({reason(error)})",
            cure=SAVE,
            file=str(path),
        ) from error
    if not isinstance(content, Mapping):
        content = {"tensor": content}
    return table_from_variables(str(path), dict(_flat(content)))


class _Content(pickle.Unpickler):
    """Read the structure of an archive; tensors become arrays, all else is refused."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        names = archive.namelist()
        name = next((each for each in names if each.endswith("data.pkl")), None)
        if name is None:
            raise ValueError("it has no data.pkl")
        super().__init__(io.BytesIO(archive.read(name)))
        self._archive, self._root = archive, name.removesuffix("data.pkl")
        order = f"{self._root}byteorder"
        big = order in names and archive.read(order).strip() == b"big"
        self._order: Literal["<", ">"] = ">" if big else "<"

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for the few names that an archive of tensors needs."""
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if module in ("torch", "torch.storage") and name in DTYPES:
            return DTYPES[name]
        raise ValueError(f"it refers to {module}.{name}, which is not read for safety")

    def persistent_load(self, pid: Any) -> Array:
        """Return a storage as a vector."""
        kind, dtype, key, _, count = pid
        if kind != "storage" or not isinstance(dtype, str) or not str(key).isdigit():
            raise ValueError(f"it holds a {kind!r} where a storage is expected")
        data = self._archive.read(f"{self._root}data/{key}")
        return np.frombuffer(data, dtype=np.dtype(dtype).newbyteorder(self._order), count=count)


def _tensor(
    storage: Array, offset: int, shape: Sequence[int], stride: Sequence[int], *_: Any
) -> Array:
    """Return the strided part of a storage that is a tensor, copied."""
    if len(shape) != len(stride) or min((offset, *shape, *stride), default=0) < 0:
        raise ValueError(f"a tensor has shape {shape} and strides {stride}")
    size = int(np.prod(shape, dtype=object))
    last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True))
    if size > storage.size or (size and last >= storage.size):
        raise ValueError(f"a tensor of shape {shape} exceeds its storage of {storage.size}")
    step = storage.itemsize
    view = np.lib.stride_tricks.as_strided(
        storage[offset:], tuple(shape), tuple(step * each for each in stride), writeable=False
    )
    return np.array(view, dtype=np.float64)


def _flat(content: Mapping[Any, Any], prefix: str = "") -> list[tuple[str, Array]]:
    found = []
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            found += _flat(value, f"{name}_")
        elif isinstance(value, np.ndarray) or (
            isinstance(value, list | tuple) and all(isinstance(each, int | float) for each in value)
        ):
            found.append((name, np.asarray(value, dtype=np.float64)))
    return found


FORMATS.register(
    "torch",
    LogFormat(
        suffixes=(".pt", ".pth"), read=lambda path, sheet: read_isolated(read_torch_archive, path)
    ),
)
