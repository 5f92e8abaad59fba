"""The sheet that makes a log readable: what reading and checking find, round after round."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import TextWrapper
from typing import Any

import numpy as np

from asbuilt.codec import format_toml, format_toml_key
from asbuilt.description.model import RobotModel
from asbuilt.errors import AsbuiltError, RecordingError
from asbuilt.experiment.logs.columns.layout import Layout
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.long_recordings import head_of
from asbuilt.experiment.logs.readers import find_sheet, find_table_layout, read_table
from asbuilt.experiment.logs.reading_options import ReadingOptions
from asbuilt.experiment.logs.recordings import read_fitted_recordings
from asbuilt.experiment.logs.sheet import RecordingSheet
from asbuilt.experiment.quality.checks import RecordingCheck, check_recording
from asbuilt.experiment.recording import OF_JOINTS, Recording
from asbuilt.findings import Cure

MOST_ROUNDS = 8
"""Rounds of reading and checking: columns, times, positions, velocities and signs, one by one."""
UNIT_NAMES = {
    math.pi / 180: {"position": "deg", "command": "deg", "velocity": "deg/s"},
    1e-3: {"time": "ms", "torque": "mN m"},
    1e-6: {"time": "us"},
    1e-9: {"time": "ns"},
}
"""Names of the units of factors to SI, by quantity."""
LISTED = ("position", "velocity", "torque", "command")
"""Quantities whose columns a sheet lists."""


@dataclass(frozen=True)
class SheetProposal:
    """Hold the sheet proposed for a log, and what it leads to.

    Parameters
    ----------
    content
        Fields of the sheet.
    reasons
        Why each of them was found, in sentences.
    changed
        Whether the log needs any of it.
    check
        The check of the log read with it; None if it cannot be read with it either.
    problem
        Why it cannot be read, None if it can.
    """

    content: Mapping[str, Any]
    reasons: tuple[str, ...]
    changed: bool
    check: RecordingCheck | None
    problem: AsbuiltError | None = None

    @property
    def outcome(self) -> str:
        """What the log is with this sheet, in a few words."""
        if self.check is None or self.problem is not None:
            return "it cannot be read"
        if self.check.errors:
            codes = ", ".join(dict.fromkeys(finding.code for finding in self.check.errors))
            return f"NOT READY ({codes})"
        return "READY WITH CARE" if self.check.warnings else "READY"

    @property
    def text(self) -> str:
        """The sheet as TOML, with the reasons as comments."""
        head = ["# How the log is read, as asbuilt check found it; correct what is wrong."]
        # Names and paths stay whole.
        fold = TextWrapper(76, break_long_words=False, break_on_hyphens=False).wrap
        head += [f"# {line}" for reason in self.reasons for line in fold(reason)]
        return "\n".join([*head, *format_sheet(self.content)]) + "\n"


def propose_sheet(
    model: RobotModel, files: Sequence[str | Path], options: ReadingOptions | None = None
) -> SheetProposal:
    """Return the sheet with which a log can be read, and the check of the log as read with it.

    The log is read and checked; what reading or a finding names as the field that cures is added to
    the sheet, until nothing is left that a file can tell. Fields that the log's own sheet or the
    options give stay.

    Parameters
    ----------
    model
        Robot as described.
    files
        The log: a file, a folder, or files of one quantity each.
    options
        How it is read.

    Returns
    -------
    SheetProposal
        The sheet, complete: columns, units, clock and sign.
    """
    chosen = options or ReadingOptions()
    paths = [Path(path) for path in files]
    given, _ = find_sheet(paths[0], chosen.sheet)
    # Fields that the log's own sheet gives are no proposal.
    content = given.model_dump(exclude_unset=True, exclude_none=True)
    content, chosen = _state_options(content, chosen)
    start = dict(content)
    reasons: list[str] = []
    check: RecordingCheck | None = None
    problem: RecordingError | None = None
    # One change a round: reading with it changes what the next finding says.
    for _ in range(MOST_ROUNDS):
        try:
            fitted, recording = _read(model, paths, chosen, content)
        # What is not read cannot be checked: its own error has the cure.
        except RecordingError as raised:
            problem = raised
            cures = [(raised.message, raised.cure)]
        else:
            problem = None
            check = check_recording(fitted, recording)
            cures = [(f.message, f.cure) for f in (*check.errors, *check.warnings)]
        # Errors first, so that they are cured first.
        found = _find_change(cures, content, check)
        if found is None:
            break
        change, reason = found
        content = merge_fields(content, change)
        # Paths of this machine do not belong into a sheet.
        reasons.append(reason.replace(f"{paths[0]}", paths[0].name))
    changed = content != start
    if problem is None and check is not None:
        content = _complete(model, paths, chosen, content, head_of(recording))
    return SheetProposal(content, tuple(reasons), changed, check, problem)


def _state_options(
    content: Mapping[str, Any], options: ReadingOptions
) -> tuple[dict[str, Any], ReadingOptions]:
    """Return the sheet with what options state of the log, and the options without it.

    A sheet is complete: with it no option need be given again.
    """
    stated = dict(content)
    left = options
    if options.rate is not None and "rate" not in stated:
        stated["rate"] = float(options.rate)
        left = replace(left, rate=None)
    if options.gain is not None:
        stated["gains"] = np.atleast_1d(np.asarray(options.gain, dtype=np.float64)).tolist()
        left = replace(left, gain=None)
    if options.torque_source is not None:
        stated["torque_source"] = options.torque_source
        left = replace(left, torque_source=None)
    if options.window is not None:
        stated["windows"] = [
            {"start": start, "stop": stop} if math.isfinite(stop) else {"start": start}
            for start, stop in options.windows
        ]
        left = replace(left, window=None)
    if options.flip_torque and "sign" not in stated:
        stated["sign"] = -1
        left = replace(left, flip_torque=False)
    return stated, left


def _read(
    model: RobotModel, paths: Sequence[Path], options: ReadingOptions, content: Mapping[str, Any]
) -> tuple[RobotModel, Any]:
    """Return the robot as recorded and the recording, read with these fields of a sheet."""
    # A proposal is tested by reading the log with it.
    sheet = RecordingSheet.model_validate(content)
    fitted, ((recording,),) = read_fitted_recordings(
        model, [[*paths]], replace(options, sheet=sheet)
    )
    return fitted, recording


def _find_change(
    cures: Sequence[tuple[str, Cure | None]],
    content: Mapping[str, Any],
    check: RecordingCheck | None,
) -> tuple[dict[str, Any], str] | None:
    """Return the first fields that cure and are not in the sheet yet, with the reason."""
    for message, cure in cures:
        if cure is None:
            continue
        change = dict(cure.sheet)
        # A sign that the sheet has must not be turned round by round.
        if cure.settings.get("flip_torque") and "sign" not in content:
            change = {"sign": -1}
        for name in ("rate", "torque_source"):
            value = cure.settings.get(name)
            # Placeholders such as HZ are words for the user.
            if isinstance(value, float) or (name == "torque_source" and value == "command"):
                change = {name: value}
        if (
            change
            and merge_fields(content, change) != content
            and not _contradicts(content, change)
        ):
            return change, " ".join(message.split())
    return None


def _contradicts(content: Mapping[str, Any], change: Mapping[str, Any]) -> bool:
    """Return whether the sheet has another value already, so that rounds would go in circles."""
    return any(
        name in content
        and (
            _contradicts(content[name], value)
            if isinstance(value, Mapping) and isinstance(content[name], Mapping)
            else content[name] != value
        )
        for name, value in change.items()
    )


def merge_fields(content: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a sheet with others added, tables entry by entry.

    >>> merge_fields({"units": {"time": "ms"}}, {"units": {"position": "deg"}})
    {'units': {'time': 'ms', 'position': 'deg'}}
    """
    merged = dict(content)
    for name, value in change.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(name), Mapping)
        merged[name] = merge_fields(merged[name], value) if both else value
    return merged


def _complete(
    model: RobotModel,
    paths: Sequence[Path],
    options: ReadingOptions,
    content: Mapping[str, Any],
    recording: Recording,
) -> dict[str, Any]:
    """Return the sheet with all columns and units; as it is where that would read otherwise."""
    try:
        sheet = RecordingSheet.model_validate(content)
        table = read_table([*paths], sheet)
        layout = find_table_layout(table, sheet, model.on_held_base, options)
        # Completed sheets are kept only if they read the same.
        full = merge_fields(content, _list_columns(table, layout, content))
        again = head_of(_read(model, paths, options, full)[1])
    except (AsbuiltError, ValueError):
        return dict(content)
    return full if _are_equal(recording, again) else dict(content)


def _are_equal(one: Recording, other: Recording) -> bool:
    """Return whether two readings of a log have the same joints and values."""
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("t", *OF_JOINTS)]
    same = all(
        b is None if a is None else b is not None and np.array_equal(a, b, equal_nan=True)
        for a, b in pairs
    )
    return (
        same and one.joint_names == other.joint_names and one.torque_source == other.torque_source
    )


def _list_columns(table: LogTable, layout: Layout, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return columns, units and joints of a log whose format does not give them."""
    if table.known:
        return {}
    order = table.order or tuple(table.columns)

    def name(column: str) -> Any:
        # Columns without names go by number, counted from 1.
        return column if table.named else order.index(column) + 1

    stated = content.get("units", {})
    columns: dict[str, Any] = {}
    units: dict[str, str] = {}
    for quantity in LISTED:
        names = layout.quantities.get(quantity, ())
        if not names or not all(names):
            continue
        columns[quantity] = [name(column) for column in names]
        # A unit that the sheet states wins over one that was guessed.
        if quantity in stated:
            continue
        # Columns of several units have no one name: the sheet says nothing of them.
        unit = _name_unit(quantity, [layout.scales.get(column, 1.0) for column in names])
        if unit is None:
            return {}
        units |= {quantity: unit} if unit else {}
    if layout.time is not None and layout.nanoseconds is None:
        columns["time"] = name(layout.time)
        unit = _name_unit("time", [layout.scales.get(layout.time, 1.0)])
        units |= {"time": unit} if unit and "time" not in stated else {}
    found: dict[str, Any] = {"columns": columns}
    if units:
        found["units"] = units
    if table.named:
        found["joints"] = list(layout.joint_names)
    if layout.torque_source != "unknown":
        found["torque_source"] = content.get("torque_source", layout.torque_source)
    return found


def _name_unit(quantity: str, scales: Sequence[float]) -> str | None:
    """Return the unit of columns, "" for SI; None if it has no name or they differ."""
    if len(set(scales)) > 1:
        return None
    if scales[0] == 1.0:
        return ""
    named = {factor: names.get(quantity) for factor, names in UNIT_NAMES.items()}
    # Factors come from divisions, and are close rather than equal.
    return next((unit for factor, unit in named.items() if math.isclose(factor, scales[0])), None)


def _format_number(value: float) -> str:
    return f"{value:.10g}"


def format_sheet(content: Mapping[str, Any]) -> list[str]:
    """Return the lines of a recording sheet in TOML.

    >>> format_sheet({"rate": 100.0, "columns": {"position": [2, 3, 4], "time": 1}})
    ['rate = 100', '', '[columns]', 'position = "2-4"', 'time = 1']
    """
    tables = {name: value for name, value in content.items() if isinstance(value, Mapping)}
    lines = [
        f"{name} = {format_toml(value, _format_number)}"
        for name, value in content.items()
        if name not in tables and value is not None
    ]
    # Columns last: the longest table.
    for name in [*(table_name for table_name in tables if table_name != "columns"), "columns"]:
        entries = {key: value for key, value in tables.get(name, {}).items() if value is not None}
        if entries:
            lines += ["", f"[{name}]"]
            lines += [
                f"{format_toml_key(key)} = "
                + ((name == "columns" and _find_span(value)) or format_toml(value, _format_number))
                for key, value in entries.items()
            ]
    return lines


def _find_span(value: Any) -> str:
    """Return columns that follow one another as a range, "" if they do not.

    >>> _find_span([2, 3, 4]), _find_span(["q_1", "q_2", "q_3"]), _find_span(["q_1", "q_3", "q_4"])
    ('"2-4"', '"q_1-q_3"', '')
    """
    listed = value if isinstance(value, list) else []
    # Leading zeros are part of a name, no number.
    found = [re.fullmatch(r"(\D*?)(0|[1-9]\d*)", str(name)) for name in listed]
    if len(found) < 3 or None in found:
        return ""
    stems = {match[1] for match in found if match}
    numbers = [int(match[2]) for match in found if match]
    rises = numbers == [*range(numbers[0], numbers[0] + len(numbers))]
    text = f"{listed[0]}-{listed[-1]}"
    return format_toml(text) if len(stems) == 1 and rises else ""
