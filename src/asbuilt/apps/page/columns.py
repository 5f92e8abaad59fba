"""The command that shows which column of a log is which quantity of which joint: columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w
import typer

import asbuilt
from asbuilt import Cure, ReadingOptions, RecordingError, UsageError
from asbuilt.arrays import Array
from asbuilt.cli import AsJson, Full, Robot, answer, describe_cure
from asbuilt.experiment import (
    BASE_VECTORS,
    QUANTITIES,
    Layout,
    LogTable,
    RecordingSheet,
    check_readable,
    choose_log_format,
    find_layout,
    find_sheet,
    find_table_layout,
    is_long,
    parse_unit_scale,
    read_table,
    suggest_sheet,
)
from asbuilt.tables import Column, Table
from asbuilt.untrusted import parse_toml
from asbuilt.writing import atomic_write

CURVE_POINTS = 160
"""Points of the curve of a column, which is drawn as wide as a word or two."""
FIRST_ROWS = 100_000
"""Rows of a long log that are read: those by which a stream is checked first."""


@dataclass(frozen=True)
class MatchedColumns:
    """Hold the columns of a log and what they were matched to.

    Parameters
    ----------
    model
        The robot, without the joints that the log lacks.
    table
        The columns; of a long log its first rows.
    layout
        Which column holds which quantity of which joint; a draft if there is a problem, None
        without even that.
    problem
        Why the columns do not fit the robot, and what to do.
    """

    model: asbuilt.RobotModel
    table: LogTable
    layout: Layout | None
    problem: str = ""

    @property
    def ok(self) -> bool:
        """Whether every column that is needed was found."""
        return not self.problem

    def role(self, column: str) -> tuple[str, str] | None:
        """Return quantity and joint of a column, the joint empty for times; None if it has none."""
        if self.layout is None:
            return None
        if column == self.layout.time:
            return "time", ""
        places = (
            (quantity, joint)
            for quantity, names in self.layout.quantities.items()
            for name, joint in zip_longest(names, self.layout.joint_names, fillvalue="")
            if name == column
        )
        return next(places, None)

    def as_document(self) -> dict[str, Any]:
        """Return what `asbuilt columns --json` prints."""
        return {
            "robot": self.model.name,
            "source": self.table.source,
            "ok": self.ok,
            "problem": self.problem or None,
            "joints": list(self.model.joint_names),
            "torque_source": None if self.layout is None else self.layout.torque_source,
            "named": self.table.named,
            "n_samples": self.table.n_samples,
            "columns": [self._describe_column(name) for name in self.table.columns],
        }

    def _describe_column(self, name: str) -> dict[str, Any]:
        from asbuilt.writers import thin_curves

        values = self.table.columns[name]
        quantity, joint = self.role(name) or (None, None)
        rows = np.arange(len(values), dtype=np.float64)
        finite = values[np.isfinite(values)]
        across, curve = thin_curves(rows, values, points=CURVE_POINTS)
        lowest = float(finite.min()) if finite.size else 0.0
        return {
            "name": name,
            "quantity": quantity,
            "joint": joint or None,
            "factor": None if self.layout is None else self.layout.scales.get(name),
            "smallest": lowest if finite.size else None,
            "largest": float(finite.max()) if finite.size else None,
            "curve": {"row": _list_values(across), "above_smallest": _list_values(curve - lowest)},
        }

    def as_text(self, full: bool = False) -> str:
        """Return a table of the columns, those without a role left out unless `full`."""
        heads = (
            Column("column", width=34),
            Column("quantity"),
            Column("joint", width=20),
            Column("smallest", align="decimal"),
            Column("largest", align="decimal"),
        )
        rows = [self._describe_column(name) for name in self.table.columns]
        shown = [row for row in rows if full or row["quantity"] or self.layout is None]
        title = f"{len(shown)} of {len(rows)} columns of {self.table.source} are used"
        if self.problem:
            title = f"columns of {self.table.source}"
        cells = tuple(
            (
                row["name"],
                row["quantity"] or "",
                row["joint"] or "",
                *(
                    None if row[end] is None else f"{row[end]:.4g}"
                    for end in ("smallest", "largest")
                ),
            )
            for row in shown
        )
        return (f"{self.problem}\n\n" if self.problem else "") + Table(
            heads, cells, title=title
        ).as_text(full)


def columns(
    robot: Robot,
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", help="a recording: .csv .parquet .npz .mat .h5 or a ROS bag"),
    ],
    reading: ReadingOptions,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Show which column of a log is which quantity of which joint.

    What is wrong is changed by a recording sheet (--sheet).
    """
    model = asbuilt.load_robot(robot, fixed_base=reading.fixed_base)
    matched = match_columns(model, log, reading)
    answer(as_json, matched.as_document, lambda: matched.as_text(full))
    if not matched.ok:
        raise typer.Exit(1)


def match_columns(model: asbuilt.RobotModel, log: Path, reading: ReadingOptions) -> MatchedColumns:
    """Match the columns of a log to the joints of a robot, as reading does.

    Raises `RecordingError` if the file is no table of numbers.
    """
    check_readable(log)
    sheet, _ = find_sheet(log, reading.sheet)
    table = _read_columns(log, sheet)
    try:
        fitted, layout = _find_layout(table, sheet, model, reading)
    except RecordingError as problem:
        cure = describe_cure(problem.cure)
        message = problem.message + (f"; {cure}" if cure else "")
        return MatchedColumns(model, table, _draft_layout(table, sheet, model, reading), message)
    return MatchedColumns(fitted, table, layout)


def _draft_layout(
    table: LogTable, sheet: RecordingSheet, model: asbuilt.RobotModel, reading: ReadingOptions
) -> Layout | None:
    """Return what the names of the columns alone give, else their values; None if nothing."""
    if table.named:
        with suppress(RecordingError):
            return find_layout(table, sheet=sheet, has_gains=True)
    with suppress(RecordingError, ValueError):
        draft = RecordingSheet.model_validate(parse_toml(suggest_sheet(table, model, reading.rate)))
        return find_table_layout(table, draft, model, reading)
    return None


def _read_columns(log: Path, sheet: RecordingSheet) -> LogTable:
    """Return the columns of a log, the first rows of a long one."""
    stream = choose_log_format(log).stream(log, sheet) if is_long(log) else None
    return read_table([log], sheet) if stream is None else stream.read_first(FIRST_ROWS)


def _find_layout(
    table: LogTable, sheet: RecordingSheet, model: asbuilt.RobotModel, reading: ReadingOptions
) -> tuple[asbuilt.RobotModel, Layout]:
    """Return the layout, and the robot without the joints that the log lacks."""
    asked = (*sheet.lock, *(reading.lock or ()))
    model = model.locked(dict.fromkeys(name for name in asked if name in model.joint_names))
    while True:
        try:
            return model, find_table_layout(table, sheet, model, reading)
        except RecordingError as problem:
            missing = problem.fields.get("missing")
            if not missing:
                raise
            model = model.locked(dict.fromkeys(missing))


def _list_values(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values.tolist()]


UNITS = ("deg", "mrad", "mm", "rpm", "mN m", "kN m", "mA", "ms", "us", "ns")
"""Units other than SI that a column may have been found to be in."""
ENTRY = ("name", "quantity", "joint")
COLUMN_ENTRIES = "a list of objects with name, quantity and joint, each a text"
SAME_UNIT = 1e-6
"""Relative difference of the factors of one unit."""


def write_sheet(
    path: Path,
    log: Path,
    given: str | None,
    document: Mapping[str, Any],
    chosen: Any,
) -> Path:
    """Write the sheet that reads a log by the columns chosen.

    Parameters
    ----------
    path
        The sheet to write.
    log
        The log.
    given
        The sheet that it was read with; None: the one next to the log, if there is one. Its other
        fields are kept.
    document
        What `asbuilt columns --json` printed: factors to SI, the source of torque.
    chosen
        For each column `name`, `quantity` and `joint`, empty where it has none.

    Raises
    ------
    UsageError
        If what is chosen is no list of columns of the log, if a joint has two columns of one
        quantity or a quantity has columns of some joints only, or if the sheet lists files.
    """
    _check_columns(document, chosen)
    sheet, _ = find_sheet(log, given)
    content = sheet.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    if "files" in content:
        raise UsageError(
            f"the sheet of {log} lists files, which the page does not change",
            cure=Cure("edit the sheet itself"),
        )
    factors = {column["name"]: column["factor"] for column in document["columns"]}
    joints = [
        joint
        for joint in document["joints"]
        if any(column["quantity"] == "position" and column["joint"] == joint for column in chosen)
    ]
    columns: dict[str, Any] = {}
    units: dict[str, str] = dict(content.get("units", {}))
    for quantity in ("time", *QUANTITIES):
        names = _order_columns(quantity, joints, chosen)
        found = [column["name"] for column in document["columns"] if column["quantity"] == quantity]
        # A sheet that names the time takes it from that column alone, without its nanoseconds.
        if names and not (quantity == "time" and document["named"] and names == found):
            listed = names if document["named"] else [int(name) for name in names]
            columns[quantity] = listed[0] if quantity == "time" else listed
            unit = _choose_unit(quantity, [factors.get(name) for name in names])
            if unit:
                units.setdefault(quantity, unit)
    others = ("extra", "contact", *BASE_VECTORS)
    stated = content.get("columns", {})
    content["columns"] = columns | {name: stated[name] for name in others if name in stated}
    content["joints"] = joints
    if units:
        content["units"] = units
    source = document.get("torque_source")
    if source not in (None, "unknown"):
        content.setdefault("torque_source", source)
    return atomic_write(path, tomli_w.dumps(content))


def _check_columns(document: Mapping[str, Any], chosen: Any) -> None:
    """Raise `UsageError` unless each entry gives a column of the log a quantity and a joint."""
    if not isinstance(chosen, list):
        raise UsageError(f"columns are {COLUMN_ENTRIES}")
    known = {column["name"] for column in document["columns"]}
    quantities = {"", "time", *QUANTITIES, *(column["quantity"] for column in document["columns"])}
    for entry in chosen:
        texts = [entry.get(key) for key in ENTRY] if isinstance(entry, dict) else [None]
        if not all(isinstance(text, str) for text in texts):
            raise UsageError(f"columns are {COLUMN_ENTRIES}")
        name, quantity, joint = map(str, texts)
        place = f"column {name[:80]!r}"
        if name not in known:
            raise UsageError(f"{place} is given twice, or is none of the log", value=name[:80])
        known.remove(name)
        if quantity not in quantities:
            raise UsageError(f"{place}: {quantity[:80]!r} is no quantity", available=[*QUANTITIES])
        if quantity in QUANTITIES and joint not in document["joints"]:
            raise UsageError(
                f"{place}: {joint[:80]!r} is no joint of {document['robot']}",
                cure=Cure("choose a joint of the robot, or no quantity"),
                available=document["joints"],
            )


def _order_columns(
    quantity: str, joints: Sequence[str], chosen: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Return the columns of a quantity in the order of the joints, none if it has none."""
    own = [column for column in chosen if column["quantity"] == quantity]
    if quantity == "time":
        if len(own) > 1:
            raise UsageError(f"{own[0]['name']} and {own[1]['name']} are both the time; choose one")
        return [column["name"] for column in own]
    names = []
    for joint in joints if own else ():
        found = [column["name"] for column in own if column["joint"] == joint]
        if len(found) != 1:
            what = " and ".join(found) if found else "no column"
            raise UsageError(
                f"{joint} has {what} of {quantity}; it must have one, or no joint may have any"
            )
        names += found
    return names


def _choose_unit(quantity: str, factors: Sequence[float | None]) -> str | None:
    """Return the unit that the columns were found to be in; None for SI or an unknown one."""
    known = {factor for factor in factors if factor is not None}
    if known <= {1.0}:
        return None
    for unit in UNITS:
        scale = parse_unit_scale(unit)
        if scale is not None and all(abs(scale / factor - 1.0) < SAME_UNIT for factor in known):
            return unit
    raise UsageError(
        f"the columns of {quantity} have the factors {', '.join(f'{factor:g}' for factor in known)}"
        " to SI, which a sheet cannot name by one unit",
        cure=Cure("write the sheet by hand"),
    )
