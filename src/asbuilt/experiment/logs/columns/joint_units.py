"""Units of single joints: shares of a calibrated range, as of grippers, and angles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from asbuilt.description.joint_matching import names_gripper
from asbuilt.errors import RecordingError
from asbuilt.experiment.logs.columns.layout import Layout
from asbuilt.experiment.logs.columns.roles import parse_unit_scale
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.experiment.logs.sheet import RecordingSheet, SheetRange
from asbuilt.findings import Cure


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
        if joint in units:
            factor, offset = _find_conversion(units[joint])
        elif column in table.ranges and _is_calibrated(table, column, sheet):
            first, last, lower, upper = table.ranges[column]
            calibrated = SheetRange(logged=(first, last), position=(lower, upper))
            factor, offset = _find_conversion(calibrated)
        else:
            if column in table.open_units and held.get(joint) is None:
                _refuse_open(table, column, joint, sheet)
            continue
        shifts = {"position": offset, "command": offset, "velocity": 0.0, "acceleration": 0.0}
        for quantity, shift in shifts.items():
            if quantity in layout.quantities:
                column = layout.quantities[quantity][k]
                scales[column], offsets[column] = factor, shift
    return replace(layout, scales=scales, offsets=offsets)


def _is_calibrated(table: LogTable, column: str, sheet: RecordingSheet) -> bool:
    """Return whether a calibration gives the unit: the sheet gives none, or not the gripper's."""
    stated = sheet.units.position is not None and not names_gripper(table.known[column][1])
    return column not in table.open_units and not stated


def _find_conversion(unit: str | SheetRange) -> tuple[float, float]:
    """Return factor and offset that turn a number of the log into SI."""
    if isinstance(unit, str):
        return parse_unit_scale(unit) or 1.0, 0.0
    (first, last), (lower, upper) = unit.logged, unit.position
    factor = (upper - lower) / (last - first)
    return factor, lower - factor * first


def _refuse_open(table: LogTable, column: str, joint: str, sheet: RecordingSheet) -> None:
    """Raise unless the sheet gives the unit of positions, in which grippers are not."""
    gripper = names_gripper(table.known[column][1])
    if sheet.units.position is not None and not gripper:
        return
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
        ends = {
            known: (table.ranges[each][2:])
            for each, (quantity, known) in table.known.items()
            if quantity == "position" and each in table.ranges
        }
        lines = "\n".join(
            f"{known} = {{ logged = [-100, 100], position = [{lower:.6f}, {upper:.6f}] }}"
            for known, (lower, upper) in ends.items()
            if not names_gripper(known)
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
    raise RecordingError(
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
