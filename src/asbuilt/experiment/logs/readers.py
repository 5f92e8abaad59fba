"""Reading of one recording from files, data frames or arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.joint_matching import names_gripper
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.assembly import (
    FILE_QUANTITIES,
    apply_sheet,
    build_recording,
    keep_windows,
    merge_role_files,
)
from asbuilt.experiment.logs.columns.layout import Layout, find_layout
from asbuilt.experiment.logs.columns.roles import (
    parse_file_quantity,
    parse_unit_scale,
    recognise_any,
)
from asbuilt.experiment.logs.columns.unnamed_columns import draft_sheet
from asbuilt.experiment.logs.formats.log_format import (
    LogTable,
    choose_log_format,
    is_columns,
    tabulate_columns,
)
from asbuilt.experiment.logs.mending import LogMender
from asbuilt.experiment.logs.reading_options import PathLike, ReadingOptions, merge_reading_options
from asbuilt.experiment.logs.sheet import RecordingSheet, SheetRange, find_sheet_beside, read_sheet
from asbuilt.experiment.recording import ENCODERS, Recording
from asbuilt.experiment.root import root_of
from asbuilt.findings import Cure
from asbuilt.untrusted import note_input


def with_joint_units(
    table: LogTable, layout: Layout, sheet: RecordingSheet, held: Mapping[str, float | None]
) -> Layout:
    """Return the layout with the units that the sheet gives single joints.

    `held` are joints that are locked, with their positions if these are given.

    Raises
    ------
    RecordingError
        If the sheet names a joint that the log lacks, or lacks the unit of one that the format
        leaves open.
    """
    renamed = sheet.joints if isinstance(sheet.joints, dict) else {}
    units = {renamed.get(name, name): unit for name, unit in sheet.joint_units.items()}
    unknown = [name for name in units if name not in layout.joint_names]
    logged = {joint for _, joint in table.known.values()} | set(renamed.values())
    if unknown and not set(unknown) <= logged:
        raise RecordingError(
            f"{table.source}: the sheet gives units of {', '.join(unknown)}, and the joints are"
            f" {', '.join(layout.joint_names)}",
            file=table.source,
            value=unknown,
            available=list(layout.joint_names),
        )
    scales = dict(layout.scales)
    offsets = dict(layout.offsets)
    for k, joint in enumerate(layout.joint_names):
        column = layout.quantities["position"][k]
        unit = units.get(joint) or _find_calibrated_range(table, column, sheet)
        if unit is None:
            is_open = column in table.open_units and held.get(joint) is None
            if is_open and not _states_unit(table, column, sheet):
                raise _make_open_unit_error(table, column, joint)
            continue
        factor, offset = _find_conversion(unit)
        of_position = dict.fromkeys(("position", "command", *ENCODERS.values()), offset)
        shifts = {**of_position, "velocity": 0.0, "acceleration": 0.0}
        for quantity, shift in shifts.items():
            if quantity in layout.quantities:
                column = layout.quantities[quantity][k]
                scales[column] = factor
                offsets[column] = shift
    return replace(layout, scales=scales, offsets=offsets)


def _states_unit(table: LogTable, column: str, sheet: RecordingSheet) -> bool:
    """Return whether the sheet gives the unit of a column of positions, not a gripper's."""
    return sheet.units.position is not None and not names_gripper(table.known[column][1])


def _find_calibrated_range(
    table: LogTable, column: str, sheet: RecordingSheet
) -> SheetRange | None:
    """Return the range of a column by its calibration; None if it has none, or another unit."""
    if column not in table.ranges or column in table.open_units:
        return None
    if _states_unit(table, column, sheet):
        return None
    first, last, lower, upper = table.ranges[column]
    return SheetRange(logged=(first, last), position=(lower, upper))


def _find_conversion(unit: str | SheetRange) -> tuple[float, float]:
    """Return factor and offset that turn a number of the log into SI."""
    if isinstance(unit, str):
        return parse_unit_scale(unit) or 1.0, 0.0
    first, last = unit.logged
    lower, upper = unit.position
    factor = (upper - lower) / (last - first)
    return factor, lower - factor * first


def _make_open_unit_error(table: LogTable, column: str, joint: str) -> RecordingError:
    """Return the error of a column of positions whose unit neither log nor sheet gives."""
    gripper = names_gripper(table.known[column][1])
    values = table.columns[column]
    first = float(np.nanmin(values))
    last = float(np.nanmax(values))
    mostly = "such logs have degrees, or -100 to 100 of the calibrated range"
    cure = (
        'write [units] position = "deg" in a recording sheet; or, for -100 to 100, the positions'
        f" [rad] at both ends for each joint: [joint_units] {joint} = {{ logged = [-100, 100],"
        " position = [LOWER, UPPER] }"
    )
    if column in table.ranges:
        mostly = "the motion fits degrees and -100 to 100 of the calibrated range alike"
        lines = "\n".join(
            f"{known} = {{ logged = [-100, 100], position = [{lower:.6f}, {upper:.6f}] }}"
            for name, (_, _, lower, upper) in table.ranges.items()
            for quantity, known in [table.known[name]]
            if quantity == "position" and not names_gripper(known)
        )
        cure = (
            'write [units] position = "deg" in a recording sheet; or, for -100 to 100, from the'
            f" calibration:\n\n[joint_units]\n{lines}\n"
        )
    elif gripper:
        mostly = (
            "grippers are mostly logged as shares of their range, 0 to 100 or 0 to 1, next to"
            " angles of other joints"
        )
        cure = (
            "write its positions [rad or m] at the ends of the scale in a recording sheet:"
            f" [joint_units] {joint} = {{ logged = [0, 100], position = [CLOSED, OPEN] }}, or"
            f' {joint} = "deg"; or hold it at a position [rad or m]'
        )
    return RecordingError(
        f"{table.source}: the unit of {joint}, which runs from {first:.3g} to {last:.3g}, is not"
        f" known: {mostly}",
        cure=Cure(
            cure,
            settings={"lock": f"{joint}=VALUE"} if gripper else {},
            sheet={"lock": {joint: 0.0}} if gripper else {},
        ),
        file=table.source,
        value=joint,
    )


def read_recording(
    source: PathLike | Sequence[PathLike] | Any,
    *,
    model: RobotModel | PathLike | None = None,
    options: ReadingOptions | None = None,
    **settings: Any,
) -> Recording:
    """Read one recording.

    Parameters
    ----------
    source
        A file, the folder of a ROS 2 bag, a recording sheet that lists files, several files of one
        quantity each, a pandas or polars data frame, or a dict of arrays, such as `{"t": (N,),
        "q": (N, n), "tau": (N, n)}`.
    model
        Robot whose joints order the columns, matched by name if the log has joint names: a model,
        the name of a bundled robot, or the path of a description.
    options, **settings
        How to read it: `ReadingOptions`, or single fields of it, such as `rate=100.0`.

    Returns
    -------
    Recording
        In SI units, with the torque that the drives exert.

    Raises
    ------
    RecordingError
        If the source is no recording or does not fit the robot.
    UsageError
        If an option is wrong.

    Examples
    --------
    >>> columns = {"t": [0.0, 0.01], "q_1": [0.0, 0.1], "tau_1": [1.0, 2.0]}
    >>> read_recording(columns, gain=3.0).tau.tolist()
    [[3.0], [6.0]]
    """
    chosen = merge_reading_options(options, settings)
    model = None if model is None else load_robot(model)
    if is_columns(source):
        sheet, notes = find_sheet(None, chosen.sheet)
        table = tabulate_columns(source)
    else:
        given: Any = [source] if isinstance(source, str | Path) else source
        paths = [Path(path) for path in given]
        if not paths:
            raise RecordingError("no recording is given; give at least one file")
        for path in paths:
            check_readable(path)
        sheet, notes = find_sheet(paths[0], chosen.sheet)
        table = read_table(paths, sheet)
        if len(paths) == 1 and not table.known:
            _refuse_lone_role_file(paths[0], table)
    sheet = chosen.with_windows(sheet)
    layout = find_table_layout(table, sheet, None if model is None else model.on_held_base, chosen)
    table = LogMender(layout, sheet.zero).mend(table)
    rate = chosen.rate if chosen.rate is not None else sheet.rate
    recording = build_recording(table, layout, rate=rate)
    recording = replace(recording, notes=(*notes, *table.notes, *recording.notes))

    def finish(recording: Recording) -> Recording:
        return keep_windows(apply_sheet(recording, sheet, chosen), sheet)

    if model is None:
        return finish(recording)
    return root_of(model).complete(recording, table, sheet, finish)


def read_recordings(
    paths: Sequence[PathLike],
    *,
    model: RobotModel | None = None,
    options: ReadingOptions | None = None,
    **settings: Any,
) -> list[Recording]:
    """Read several recordings into memory, as `read_recording` does one.

    Files whose names differ in the quantity alone (`run_positions.csv`, `run_efforts.csv`) are one
    recording.
    """
    chosen = merge_reading_options(options, settings)
    groups = group_files([Path(path) for path in paths])
    return [read_recording(group, model=model, options=chosen) for group in groups]


def check_readable(path: Path) -> None:
    """Raise `RecordingError` if a file or folder does not exist or may not be read."""
    try:
        if path.is_dir():
            next(path.iterdir(), None)
        elif path.is_file():
            path.open("rb").close()
            note_input(path)
        elif not path.exists():
            raise RecordingError(f"recording {path} does not exist", file=str(path))
    except OSError as error:
        raise RecordingError(
            f"recording {path} cannot be read: {error.strerror or error}", file=str(path)
        ) from None


def find_sheet(
    log: Path | None, sheet: PathLike | RecordingSheet | Mapping[str, Any] | None
) -> tuple[RecordingSheet, tuple[str, ...]]:
    """Return the sheet that is given, is the log itself, or lies next to it, and notes.

    Else it is an empty one, as for a log that is no file (None).
    """
    if sheet is None and log is not None:
        sheet = log if log.suffix == ".toml" else find_sheet_beside(log)
    if sheet is None or isinstance(sheet, RecordingSheet | Mapping):
        return RecordingSheet() if sheet is None else RecordingSheet.model_validate(sheet), ()
    path = Path(sheet)
    found = read_sheet(path)
    files = {
        quantity: None if name is None else str(path.parent / name)
        for quantity, name in found.files.model_dump().items()
    }
    found = found.model_copy(update={"files": found.files.model_copy(update=files)})
    return found, (f"recording sheet {path.name} was used",)


def group_files(paths: list[Path]) -> list[list[Path]]:
    """Group files whose names differ in the quantity alone, in the order of first appearance.

    Whole recordings stay alone, whatever their names.
    """
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for path in paths:
        check_readable(path)
        quantity, rest = parse_file_quantity(path.stem)
        key = (path.parent, rest, path.suffix) if quantity in FILE_QUANTITIES else (path, "", "")
        groups.setdefault(key, []).append(path)
    return [
        part
        for group in groups.values()
        for part in ([group] if _are_one_recording(group) else [[path] for path in group])
    ]


def _are_one_recording(group: list[Path]) -> bool:
    """Return whether files hold a quantity each, and none of them a whole recording."""
    quantities = {parse_file_quantity(path.stem)[0] for path in group}
    return len(quantities) == len(group) and not any(
        path.is_file() and _is_whole(choose_log_format(path).read(path, RecordingSheet()))
        for path in (group if len(group) > 1 else ())
    )


def find_table_layout(
    table: LogTable, sheet: RecordingSheet, model: RobotModel | None, options: ReadingOptions
) -> Layout:
    """Return the layout of a table; where that fails the error has the draft of a sheet.

    Raises
    ------
    RecordingError
        As `find_layout` and `with_joint_units` do, and for columns without names that no sheet
        describes.
    """
    if not table.named and sheet.columns.position is None:
        count = len(table.order or table.columns)
        draft = draft_sheet(table, model, options.rate or sheet.rate)
        raise RecordingError(
            f"{table.source} has {count} columns without a header row",
            cure=Cure(
                f"name them in a recording sheet {Path(table.source).stem}.toml next to it; from"
                " the values it may read as follows (column numbers from 1; check it, and add"
                " gains = [...] and torque_source if the torques are currents):\n\n"
                f"{draft.text}\n",
                sheet=draft.certain,
            ),
            file=table.source,
            value=count,
        )
    try:
        layout = find_layout(table, sheet=sheet, model=model, has_gains=options.gain is not None)
    except RecordingError as problem:
        text = ", ".join(table.text_columns)
        more = [*table.notes, *([f"columns that hold no numbers: {text}"] if text else [])]
        problem.message = ". ".join([problem.message.rstrip("."), *more])
        if "absent" in problem.fields and table.n_samples:
            draft = draft_sheet(table, model, options.rate or sheet.rate)
            if draft.decides:
                problem.cure = Cure(
                    f"{problem.cure}. From the values it may read (check it):\n\n{draft.text}\n",
                    sheet=draft.certain,
                )
        raise
    if not (sheet.joint_units or table.open_units or table.ranges):
        return layout
    held = options.lock if isinstance(options.lock, Mapping) else {}
    return with_joint_units(table, layout, sheet, sheet.lock | dict(held))


def read_table(paths: list[Path], sheet: RecordingSheet) -> LogTable:
    """Return the columns of a log, of the files of one quantity each, or of the sheet's files.

    Raises `RecordingError` if they are no recording, or several.
    """
    listed = sheet.files.model_dump().items()
    files = {quantity: Path(name) for quantity, name in listed if name is not None}
    missing = [str(path) for path in files.values() if not path.exists()]
    groups = [] if files else group_files(paths)
    listing = "; ".join(", ".join(path.name for path in group) for group in groups)
    if missing:
        raise RecordingError(
            f"the recording sheet names {(*missing, '')[0]}, which does not exist",
            file=(*missing, "")[0],
        )
    if len(groups) > 1:
        raise RecordingError(
            f"{len(paths)} files are {len(groups)} recordings, not one: {listing}",
            cure=Cure("read them one by one, or together", call="experiment.read_recordings"),
        )
    if len(groups) == 1 and len(paths) == 1:
        return choose_log_format(paths[0]).read(paths[0], sheet)
    files = files or {path.name: path for path in paths}
    return merge_role_files(
        {what: choose_log_format(path).read(path, sheet) for what, path in files.items()}
    )


def _is_whole(table: LogTable) -> bool:
    """Return whether columns give positions, and torques or commands."""
    roles = map(recognise_any, table.columns)
    found = {role.quantity for role in roles if role is not None}
    return "position" in found and bool({"torque", "current", "command"} & found)


def _refuse_lone_role_file(path: Path, table: LogTable) -> None:
    quantity, rest = parse_file_quantity(path.stem)
    if quantity is None or quantity == "time" or _is_whole(table):
        return
    others = [
        p.name
        for p in sorted(path.parent.glob(f"*{path.suffix}"))
        if p != path and parse_file_quantity(p.stem)[1] == rest and parse_file_quantity(p.stem)[0]
    ]
    nearby = f" ({', '.join(others)} lie next to it)" if others else ""
    raise RecordingError(
        f"{path} holds the {quantity} only",
        cure=Cure(
            f"give the files of all quantities together{nearby}, or list them under [files] in a"
            " recording sheet"
        ),
        file=str(path),
    )
