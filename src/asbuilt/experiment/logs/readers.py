"""Read recordings of any format, and put their columns in the order of the robot's joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment.logs.formats.delimited import read_delimited
from asbuilt.experiment.logs.formats.hdf5 import read_hdf5
from asbuilt.experiment.logs.formats.matlab import read_mat
from asbuilt.experiment.logs.formats.npz import read_npz
from asbuilt.experiment.logs.formats.parquet import read_parquet
from asbuilt.experiment.logs.formats.ros_bag import read_ros_bag
from asbuilt.experiment.logs.formats.table import Table
from asbuilt.experiment.logs.layout import Layout, find_layout
from asbuilt.experiment.logs.role_files import merge_role_files, role_groups
from asbuilt.experiment.logs.roles import quantity_of_file, recognise
from asbuilt.experiment.logs.sheet import RecordingSheet, read_sheet, sheet_beside
from asbuilt.experiment.logs.unnamed_columns import suggest_sheet
from asbuilt.experiment.recording import Recording, TorqueSource

PathLike = str | Path
TEXT_SUFFIXES = {".csv", ".txt", ".tsv", ".dat"}
PACKED = {
    **dict.fromkeys((".gz", ".zip", ".bz2", ".xz", ".zst", ".7z"), "; unpack it first"),
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "; export the sheet as CSV"),
    **dict.fromkeys((".bag",), "; convert the ROS 1 bag with rosbags-convert"),
}
"""What to do first with other files."""
SUFFIXES = (*sorted(TEXT_SUFFIXES), ".parquet", ".npz", ".mat", ".h5", ".hdf5", ".db3", ".mcap")


class ReadingOptions(TypedDict, total=False):
    """The options of `read_recording`, for those who pass them on."""

    model: RobotModel | None
    sheet: PathLike | RecordingSheet | None
    rate: float | None
    flip_torque: bool
    gain: ArrayLike | None
    torque_source: TorqueSource | None


def read_recording(
    paths: PathLike | Sequence[PathLike],
    *,
    model: RobotModel | None = None,
    sheet: PathLike | RecordingSheet | None = None,
    rate: float | None = None,
    flip_torque: bool = False,
    gain: ArrayLike | None = None,
    torque_source: TorqueSource | None = None,
) -> Recording:
    """Read one recording from a file, a ROS 2 bag, a recording sheet that lists files, or files of
    one quantity each.

    With `model` the columns come in the order of its joints, found by name where the log has names.
    `rate` [Hz] makes the clock where the log has none; `gain` (torque per logged unit, one or per
    joint) and `torque_source` stand in place of the sheet's; `flip_torque` turns the sign of what
    the log, the sheet and `gain` give.

    Raises
    ------
    RecordingError
        If the file is no recording or does not fit the robot; the message says where and what to
        do.
    UsageError
        If the rate is not a positive number.
    """
    listed = [Path(paths)] if isinstance(paths, (str, Path)) else [Path(path) for path in paths]
    if not listed:
        raise RecordingError("no recording is given; give at least one file")
    for path in listed:
        check_readable(path)
    described, sheet_notes = find_sheet(listed[0], sheet)
    table = _read_tables(listed, described)
    if table.headless and described.columns.position is None:
        raise RecordingError(_headless_message(table, listed[0], model))
    if len(listed) == 1 and not table.known:
        _refuse_lone_role_file(listed[0], table)
    try:
        layout = find_layout(
            table.source, tuple(table.columns), model=model, sheet=described, known=table.known
        )
    except RecordingError as problem:
        unread = (
            (f"columns that hold no numbers: {', '.join(table.text_columns)}",)
            if table.text_columns
            else ()
        )
        raise RecordingError(". ".join([str(problem).rstrip("."), *table.notes, *unread])) from None
    recording = build_recording(table, layout, rate=rate if rate is not None else described.rate)
    recording = replace(recording, notes=(*sheet_notes, *table.notes, *recording.notes))
    return apply_sheet(
        recording, described, flip_torque=flip_torque, gain=gain, torque_source=torque_source
    )


def read_recordings(
    paths: Sequence[PathLike], **options: Unpack[ReadingOptions]
) -> list[Recording]:
    """Read several recordings.

    Files whose names differ in the quantity alone (`run_positions.csv`, `run_efforts.csv`) are one
    recording.

    Options are those of `read_recording` and hold for all.
    """
    return [
        read_recording(group, **options) for group in grouped_files([Path(path) for path in paths])
    ]


def check_readable(path: Path) -> None:
    """Raise `RecordingError` where a file or folder is not there or may not be read."""
    try:
        if path.is_dir():
            next(path.iterdir(), None)
        elif path.is_file():
            path.open("rb").close()
        elif not path.exists():
            raise RecordingError(f"recording {path} does not exist")
    except OSError as error:
        raise RecordingError(
            f"recording {path} cannot be read: {error.strerror or error}"
        ) from None


def read_table(path: Path, sheet: RecordingSheet) -> Table:
    """Read a file of any known format into named columns.

    Raises
    ------
    RecordingError
        If the format is not known or the file cannot be read.
    """
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in {".db3", ".mcap"}:
        return read_ros_bag(path, topic=sheet.topic)
    if not path.is_file():
        raise RecordingError(
            f"{path} is not a recording: it is no regular file; save what it yields as one"
        )
    if path.stat().st_size == 0:
        raise RecordingError(f"{path} is not a recording: it is empty")
    if suffix in TEXT_SUFFIXES:
        return read_delimited(
            path, header=sheet.header, separator="" if sheet.separator == " " else sheet.separator
        )
    if suffix == ".parquet":
        return read_parquet(path)
    if suffix == ".npz":
        return read_npz(path)
    if suffix == ".mat":
        return read_mat(path)
    if suffix in {".h5", ".hdf5"}:
        return read_hdf5(path)
    cure = PACKED.get(suffix, "")
    raise RecordingError(
        f"{path} is not a recording that can be read{cure}: known are {', '.join(SUFFIXES)} and the"
        " folder of a ROS 2 bag"
    )


def find_sheet(
    log: Path, sheet: PathLike | RecordingSheet | None
) -> tuple[RecordingSheet, tuple[str, ...]]:
    """Return the sheet that is given, is the log itself, or lies beside it; else an empty one."""
    if isinstance(sheet, RecordingSheet):
        return sheet, ()
    path = Path(sheet) if sheet is not None else log if log.suffix == ".toml" else sheet_beside(log)
    if path is None:
        return RecordingSheet(), ()
    return _with_paths(read_sheet(path), path.parent), (f"recording sheet {path.name} was used",)


def build_recording(
    table: Table,
    layout: Layout,
    *,
    rate: float | None,
    first_sample: int = 0,
    origin: float | None = None,
) -> Recording:
    """Put a table's columns in joint order and SI units, and make the clock.

    The time column, or `rate` [Hz] from `first_sample` on.

    Times later than 1e6 s (a calendar's) count from `origin`, the first of them where None.
    """
    if rate is not None and not 0.0 < rate < np.inf:
        raise UsageError(f"the sampling rate must be a positive number of Hz, got {rate:g}")
    notes = list(layout.notes)
    if layout.time is not None:
        t = table.columns[layout.time] * layout.scales.get(layout.time, 1.0)
        start = origin if origin is not None else clock_origin(t)
        if start != 0:
            t = t - start
            notes.append(f"times count from {start:.6f} s")
        if rate is not None:
            notes.append(
                f"the rate of {rate:g} Hz was not used: the log has the time column {layout.time!r}"
            )
    elif rate is None:
        raise RecordingError(
            f"{table.source} has no time column and no rate is given; give it with --rate HZ, or as"
            " rate = HZ in a recording sheet. Its columns are"
            f" {', '.join(list(table.columns)[:30])}"
        )
    else:
        t = np.arange(first_sample, first_sample + table.n_samples, dtype=np.float64) / rate
    arrays = {
        quantity: _stack(table.columns, names, layout.scales)
        for quantity, names in layout.quantities.items()
    }
    return Recording(
        t=t,
        q=arrays.pop("position"),
        tau=arrays.pop("torque"),
        qd=arrays.pop("velocity", None),
        qdd=arrays.pop("acceleration", None),
        joint_names=layout.joint_names,
        source=table.source,
        torque_source=layout.torque_source,
        notes=tuple(notes),
        extra=arrays,
    )


def apply_sheet(
    recording: Recording,
    sheet: RecordingSheet,
    *,
    flip_torque: bool = False,
    gain: ArrayLike | None = None,
    torque_source: TorqueSource | None = None,
) -> Recording:
    """Apply sign, gains, torque source and time windows.

    `gain` stands in place of the sheet's gains, and `flip_torque` turns the sign that results.
    """
    source = torque_source or sheet.torque_source
    if source is not None:
        recording = replace(recording, torque_source=source)
    if sheet.sign is not None:
        signs = np.atleast_1d(np.asarray(sheet.sign, dtype=np.float64))
        if signs.size not in (1, recording.n_joints):
            raise RecordingError(
                f"{recording.source}: the sheet gives {signs.size} signs for {recording.n_joints}"
                " joints"
            )
        if np.all(signs < 0):
            recording = recording.flipped()
        elif np.any(signs < 0):
            recording = replace(recording.scaled(signs), gains=recording.gains)
    factor = gain if gain is not None else sheet.gains
    if factor is not None:
        recording = recording.scaled(factor)
    if flip_torque:
        recording = recording.flipped()
    if sheet.windows:
        inside = sheet.in_windows(recording.t, float(recording.t[0]))
        kept = recording.taken(inside, "no sample lies in the time windows of its sheet")
        recording = replace(
            kept,
            notes=(
                *kept.notes,
                (
                    f"{kept.n_samples} of {recording.n_samples} samples lie in the time windows of"
                    " the sheet"
                ),
            ),
        )
    return recording


def clock_origin(t: Array) -> float:
    """Return the first time where a clock counts from long ago, else zero."""
    finite = t[np.isfinite(t)]
    return float(finite[0]) if finite.size and abs(finite[0]) > 1e6 else 0.0


def _read_tables(paths: list[Path], sheet: RecordingSheet) -> Table:
    files = {
        quantity: Path(name)
        for quantity, name in sheet.files.model_dump().items()
        if name is not None
    }
    if files:
        missing = [str(path) for path in files.values() if not path.exists()]
        if missing:
            raise RecordingError(f"the recording sheet names {missing[0]}, which does not exist")
        return merge_role_files(
            {quantity: read_table(path, sheet) for quantity, path in files.items()}
        )
    groups = grouped_files(paths)
    if len(groups) > 1:
        listing = "; ".join(", ".join(path.name for path in group) for group in groups)
        raise RecordingError(
            f"{len(paths)} files are {len(groups)} recordings, not one: {listing}. Read them with"
            " read_recordings, one recording each"
        )
    if len(paths) == 1:
        return read_table(paths[0], sheet)
    return merge_role_files({path.name: read_table(path, sheet) for path in paths})


def grouped_files(paths: list[Path]) -> list[list[Path]]:
    """Group files of one quantity each, but not whole recordings whose names say `torque` or
    `position` by chance.
    """
    for path in paths:
        check_readable(path)
    groups: list[list[Path]] = []
    for group in role_groups(paths):
        whole = len(group) > 1 and any(
            path.is_file() and _is_whole(read_table(path, RecordingSheet())) for path in group
        )
        groups.extend([[path] for path in group] if whole else [group])
    return groups


def _is_whole(table: Table) -> bool:
    found = {role.quantity for role in map(recognise, table.columns) if role is not None}
    return "position" in found and bool({"torque", "current"} & found)


def _refuse_lone_role_file(path: Path, table: Table) -> None:
    quantity, rest = quantity_of_file(path.stem)
    if quantity is None or quantity == "time" or _is_whole(table):
        return
    others = [
        p.name
        for p in sorted(path.parent.glob(f"*{path.suffix}"))
        if p != path and quantity_of_file(p.stem)[1] == rest and quantity_of_file(p.stem)[0]
    ]
    beside = f": {', '.join(others)} lie beside it" if others else ""
    raise RecordingError(
        f"{path} seems to hold the {quantity} alone; give the files of all quantities"
        f" together{beside}, or list them in a recording sheet under [files]"
    )


def _with_paths(sheet: RecordingSheet, folder: Path) -> RecordingSheet:
    files = {
        quantity: None if name is None else str(folder / name)
        for quantity, name in sheet.files.model_dump().items()
    }
    return sheet.model_copy(update={"files": sheet.files.model_copy(update=files)})


def _stack(
    columns: Mapping[str, Array], names: tuple[str, ...], scales: Mapping[str, float]
) -> Array:
    out = np.empty((columns[names[0]].size, len(names)))
    for k, name in enumerate(names):
        factor = scales.get(name, 1.0)
        if factor == 1.0:
            out[:, k] = columns[name]
        else:
            np.multiply(columns[name], factor, out=out[:, k])
    return out


def _headless_message(table: Table, path: Path, model: RobotModel | None) -> str:
    sheet = suggest_sheet(table.columns, None if model is None else model.n_joints)
    return (
        f"{path} has {len(table.columns)} columns without names. Say what they are in a recording"
        f" sheet {path.stem}.toml beside it, or with --sheet FILE. From the values it may read"
        " (column numbers from 1; check it, and add gains = [...] and torque_source if the torques"
        f" are currents):\n\n{sheet}\n"
    )
