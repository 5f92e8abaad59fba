"""Recordings in files of arrays: NumPy and PyTorch archives, HDF5 and MATLAB files."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.formats.log_format import (
    FORMATS,
    LogFormat,
    LogTable,
    isolate,
    tabulate_variables,
)
from asbuilt.findings import Cure
from asbuilt.isolated_reading import LIMITS, FileKind


def read_npz(path: Path) -> LogTable:
    """Read the arrays of an `.npz` archive; pickled objects are refused, not executed.

    Raises
    ------
    RecordingError
        If it holds nothing that looks like a recording.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            _refuse_bombs(path, archive)
    archive = np.load(path, allow_pickle=False)
    if isinstance(archive, np.ndarray):
        raise RecordingError(
            f"{path} holds one array of shape {archive.shape} without names", cure=Cure(NPZ.cure)
        )
    variables = {}
    pickled = []
    for name in archive.files:
        try:
            variables[name] = archive[name]
        except ValueError as error:
            if "pickle" not in str(error):
                raise
            pickled.append(name)
    if not variables:
        why = (
            f"its arrays are pickled objects ({', '.join(pickled)}), which are not read for safety"
            if pickled
            else "it holds no array"
        )
        raise RecordingError(f"{path} is not a recording: {why}", cure=Cure(NPZ.cure))
    return tabulate_variables(str(path), variables)


def _refuse_bombs(path: Path, archive: zipfile.ZipFile) -> None:
    """Raise `RecordingError` if an archive declares more than it may hold."""
    declared = sum(member.file_size for member in archive.infolist())
    most = LIMITS.memory_for(path.stat().st_size)
    if declared > most:
        raise RecordingError(
            f"{path} declares {declared / 1e9:.3g} GB of arrays; at most {most / 1e9:.3g} GB are"
            " read from a file of its size",
            cure=Cure("save it without compression, or as Parquet, which is read in chunks"),
        )


NPZ = FileKind(
    "an .npz archive of NumPy",
    cure="save named arrays of numbers: np.savez(path, t=t, q=q, tau=tau)",
)
FORMATS.register("npz", LogFormat(suffixes=(".npz",), read=isolate(read_npz, NPZ)))


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


def read_torch_archive(path: Path) -> LogTable:
    """Read the tensors of a `.pt` file: a dict of vectors and matrices, such as PACE writes.

    Nested dicts give names joined by an underscore. Objects other than tensors, numbers and texts
    are not read for safety.
    """
    with zipfile.ZipFile(path) as archive:
        _refuse_bombs(path, archive)
        content = _Content(archive).load()
    if not isinstance(content, Mapping):
        content = {"tensor": content}
    return tabulate_variables(str(path), dict(_flatten(content)))


class _Content(pickle.Unpickler):
    """Read the structure of an archive; tensors become arrays, all else is refused."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        names = archive.namelist()
        name = next((name for name in names if name.endswith("data.pkl")), None)
        if name is None:
            raise ValueError("it has no data.pkl")
        super().__init__(io.BytesIO(archive.read(name)))
        self._archive = archive
        self._root = name.removesuffix("data.pkl")
        order = f"{self._root}byteorder"
        big = order in names and archive.read(order).strip() == b"big"
        self._order: Literal["<", ">"] = ">" if big else "<"

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for the few names that an archive of tensors needs."""
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _copy_tensor
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


def _copy_tensor(
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


def _flatten(content: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Array]]:
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{name}_")
        elif isinstance(value, np.ndarray) or (
            isinstance(value, list | tuple) and all(isinstance(each, int | float) for each in value)
        ):
            yield name, np.asarray(value, dtype=np.float64)


FORMATS.register(
    "torch",
    LogFormat(
        suffixes=(".pt", ".pth"),
        read=isolate(
            read_torch_archive,
            FileKind(
                "an archive of tensors that torch.save wrote",
                cure="save a dict of tensors: torch.save({'time': t, 'dof_pos': q, 'des_dof_pos':"
                " u}, path)",
            ),
        ),
    ),
)


def read_hdf5(path: Path) -> LogTable:
    """Read every numeric dataset of an HDF5 file (also MATLAB 7.3).

    Groups are searched, and a name is the last part of its path where that is unique.

    Raises
    ------
    RecordingError
        If it takes values from other files or holds no numbers.
    """
    import h5py  # noqa: PLC0415

    # What a visitor raises is lost in h5py's locks, so that it finds and the code below refuses.
    links: dict[str, Any] = {}
    items: dict[str, Any] = {}
    variables: dict[str, Array] = {}
    with h5py.File(path, "r") as file:
        file.visititems_links(links.__setitem__)
        file.visititems(items.__setitem__)
        for name, link in links.items():
            if isinstance(link, h5py.ExternalLink):
                raise _make_foreign_error(path, name, f"links to the file {link.filename!r}")
        for name, item in items.items():
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                variables |= _read_dataset(path, name, item)
    short = [name.rsplit("/", 1)[-1] for name in variables]
    named = {
        last if short.count(last) == 1 else name: value
        for (name, value), last in zip(variables.items(), short, strict=True)
    }
    return tabulate_variables(str(path), named)


def _read_dataset(path: Path, name: str, item: Any) -> dict[str, Array]:
    """Return the numbers of a dataset, those of its fields by their names."""
    if item.is_virtual or item.external:
        raise _make_foreign_error(path, name, "takes its values from other files")
    if item.size and item.size * item.dtype.itemsize > LIMITS.memory_for(path.stat().st_size):
        raise RecordingError(
            f"{path}: the dataset {name!r} declares {item.size * item.dtype.itemsize:.3g} bytes,"
            " too many for a file of its size"
        )
    parts = {f"{name}/{each}": item[each] for each in item.dtype.names or ()} or {name: item}
    return {each: values[()] for each, values in parts.items() if values.dtype.kind in "biufc"}


def _make_foreign_error(path: Path, name: str, why: str) -> RecordingError:
    return RecordingError(
        f"{path}: {name!r} {why}, which is refused",
        cure=Cure("copy the values into one file, such as with h5repack"),
    )


FORMATS.register(
    "hdf5",
    LogFormat(suffixes=(".h5", ".hdf5"), read=isolate(read_hdf5, FileKind("HDF5", extra="hdf5"))),
)


def read_mat(path: Path) -> LogTable:
    """Read numeric variables of a `.mat` file, also inside structures; version 7.3 as HDF5."""
    with path.open("rb") as file:
        start = file.read(128)
    if start.startswith(b"MATLAB 7.3") or start[1:4] == b"HDF":
        return read_hdf5(path)
    from scipy.io import loadmat  # noqa: PLC0415 - light start

    variables: dict[str, Array] = {}
    for name, value in loadmat(path, squeeze_me=True, struct_as_record=False).items():
        if not name.startswith("__"):
            _collect(name, value, variables)
    return tabulate_variables(str(path), variables)


def _collect(name: str, value: Any, variables: dict[str, Array]) -> None:
    for field in getattr(value, "_fieldnames", ()):
        inner = field if field not in variables else f"{name}.{field}"
        _collect(inner, getattr(value, field), variables)
    if isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.number):
        variables[name] = value


FORMATS.register(
    "matlab",
    LogFormat(suffixes=(".mat",), read=isolate(read_mat, FileKind("a MATLAB file", extra="hdf5"))),
)
