"""The command that shows which column of a log is which quantity of which joint: columns."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

import asbuilt
from asbuilt import ReadingOptions, RecordingError
from asbuilt.cli.answers import answer, cure_text
from asbuilt.cli.arguments.options import AsJson, Full, Robot, described_robot

if TYPE_CHECKING:
    from asbuilt.arrays import Array
    from asbuilt.experiment.logs.columns.layout import Layout
    from asbuilt.experiment.logs.formats.log_format import LogTable
    from asbuilt.experiment.logs.sheet import RecordingSheet

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
        for quantity, names in self.layout.quantities.items():
            if column in names:
                joints = self.layout.joint_names
                place = names.index(column)
                return quantity, joints[place] if place < len(joints) else ""
        return None

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
            "columns": [self._column(name) for name in self.table.columns],
        }

    def _column(self, name: str) -> dict[str, Any]:
        from asbuilt.writers.figures.thinning import thinned

        values = self.table.columns[name]
        quantity, joint = self.role(name) or (None, None)
        rows = np.arange(len(values), dtype=np.float64)
        finite = values[np.isfinite(values)]
        across, curve = thinned(rows, values, points=CURVE_POINTS)
        lowest = float(finite.min()) if finite.size else 0.0
        return {
            "name": name,
            "quantity": quantity,
            "joint": joint or None,
            "factor": None if self.layout is None else self.layout.scales.get(name),
            "smallest": lowest if finite.size else None,
            "largest": float(finite.max()) if finite.size else None,
            "curve": {"row": _listed(across), "above_smallest": _listed(curve - lowest)},
        }

    def as_text(self, full: bool = False) -> str:
        """Return a table of the columns, those without a role left out unless `full`."""
        from asbuilt.tables import Column, Table

        heads = (
            Column("column", width=34),
            Column("quantity"),
            Column("joint", width=20),
            Column("smallest", align="decimal"),
            Column("largest", align="decimal"),
        )
        rows = [self._column(name) for name in self.table.columns]
        shown = [row for row in rows if full or row["quantity"] or self.layout is None]
        title = f"{len(shown)} of {len(rows)} columns of {self.table.source} are used"
        if self.problem:
            title = f"columns of {self.table.source}"
        cells = tuple(
            (
                row["name"],
                row["quantity"] or "",
                row["joint"] or "",
                *(None if row[end] is None else f"{row[end]:.4g}" for end in ENDS),
            )
            for row in shown
        )
        return (f"{self.problem}\n\n" if self.problem else "") + Table(
            heads, cells, title=title
        ).as_text(full)


ENDS = ("smallest", "largest")


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
    model = described_robot(robot, fixed_base=reading.fixed_base)
    matched = match_columns(model, log, reading)
    answer(as_json, matched.as_document, lambda: matched.as_text(full))
    if not matched.ok:
        raise typer.Exit(1)


def match_columns(model: asbuilt.RobotModel, log: Path, reading: ReadingOptions) -> MatchedColumns:
    """Match the columns of a log to the joints of a robot, as reading does.

    Raises `RecordingError` if the file is no table of numbers.
    """
    from asbuilt.experiment.logs.readers import check_readable, find_sheet

    check_readable(log)
    sheet, _ = find_sheet(log, reading.sheet)
    table = _columns_of(log, sheet)
    try:
        fitted, layout = _layout_of(table, sheet, model, reading)
    except RecordingError as problem:
        cure = cure_text(problem.cure)
        message = problem.message + (f"; {cure}" if cure else "")
        return MatchedColumns(model, table, _draft(table, sheet, model, reading), message)
    return MatchedColumns(fitted, table, layout)


def _draft(
    table: LogTable, sheet: RecordingSheet, model: asbuilt.RobotModel, reading: ReadingOptions
) -> Layout | None:
    """Return what the names of the columns alone give, else their values; None if nothing."""
    from asbuilt.experiment.logs.columns.layout import find_layout
    from asbuilt.experiment.logs.readers import layout_of, suggested_sheet
    from asbuilt.experiment.logs.sheet import RecordingSheet
    from asbuilt.untrusted import parsed_toml

    if table.named:
        with suppress(RecordingError):
            return find_layout(
                table.source,
                tuple(table.columns),
                sheet=sheet,
                known=table.known,
                order=table.order,
                has_gains=True,
            )
    with suppress(RecordingError, ValueError):
        draft = RecordingSheet.model_validate(
            parsed_toml(suggested_sheet(table, model, reading.rate))
        )
        return layout_of(table, draft, model, reading)
    return None


def _columns_of(log: Path, sheet: RecordingSheet) -> LogTable:
    """Return the columns of a log, the first rows of a long one."""
    from asbuilt.experiment.logs.formats.frames import numbers
    from asbuilt.experiment.logs.formats.log_format import log_format
    from asbuilt.experiment.logs.long_recordings import is_long
    from asbuilt.experiment.logs.readers import read_table

    stream = log_format(log).stream if is_long(log) else None
    header = None if stream is None else stream.header(log, sheet)
    if stream is None or header is None:
        return read_table([log], sheet)
    for _, frame in stream.frames(log, sheet, tuple(header.columns), FIRST_ROWS):
        return replace(header, columns={name: numbers(frame[name]) for name in header.columns})
    return header


def _layout_of(
    table: LogTable, sheet: RecordingSheet, model: asbuilt.RobotModel, reading: ReadingOptions
) -> tuple[asbuilt.RobotModel, Layout]:
    """Return the layout, and the robot without the joints that the log lacks."""
    from asbuilt.experiment.logs.readers import layout_of

    model = model.locked(dict.fromkeys(name for name in sheet.lock if name in model.joint_names))
    while True:
        try:
            return model, layout_of(table, sheet, model, reading)
        except RecordingError as problem:
            missing = problem.fields.get("missing")
            if not missing:
                raise
            model = model.locked(dict.fromkeys(missing))


def _listed(values: Array) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values.tolist()]
