"""The command that compares joint sensors with motors: channels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import ChannelOptions, ReadingOptions, writers
from asbuilt.cli.answers import answer, finding_text, progress_bar
from asbuilt.cli.arguments.options import (
    AsJson,
    Filtering,
    Full,
    Robot,
    Unchecked,
    described_robot,
    distinct_logs,
    number_list,
    robot_and_recordings,
)
from asbuilt.tables import wrapped


def channels(
    robot: Robot,
    log: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="recordings of the joint torque sensors")
    ],
    motor: Annotated[
        list[Path],
        typer.Option(
            "--motor", metavar="LOG", help="the same with motor torques, in the same order"
        ),
    ],
    *,
    motor_gain: Annotated[
        str | None,
        typer.Option(
            "--motor-gain", metavar="G1,G2,...", help="torque per logged unit of the motors"
        ),
    ] = None,
    motor_sheet: Annotated[
        Path | None,
        typer.Option("--motor-sheet", metavar="FILE", help="recording sheet of the motor logs"),
    ] = None,
    drive: Annotated[
        str | None,
        typer.Option(
            "--drive",
            metavar="LIST",
            help="drive terms behind the sensors (default: viscous,coulomb,offset)",
        ),
    ] = None,
    motor_drive: Annotated[
        str | None,
        typer.Option(
            "--motor-drive",
            metavar="LIST",
            help=(
                "drive terms before the sensors (default: armature,viscous,coulomb,offset, and"
                " those of coupled motors)"
            ),
        ),
    ] = None,
    unchecked: Unchecked = False,
    reading: ReadingOptions,
    filtering: Filtering,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Identify links, link-side friction and motor side from torques on both sides of the gears."""
    distinct_logs(log)
    distinct_logs(motor)
    if motor_sheet is None and motor_gain is None:
        distinct_logs(log, motor)
    model = described_robot(robot, **reading.of_base)
    on_links = replace(reading, torque_source=reading.torque_source or "sensor")
    on_motors = replace(
        reading,
        gain=number_list("--motor-gain", motor_gain) or None,
        torque_source="motor",
        sheet=motor_sheet or reading.sheet,
    )
    model, (sensors,) = robot_and_recordings(model, on_links, log)
    model, (motors,) = robot_and_recordings(model, on_motors, motor)

    options = ChannelOptions(
        link_side=None if drive is None else asbuilt.DriveSet.parse(drive),
        motor_side=None if motor_drive is None else asbuilt.DriveSet.parse(motor_drive),
        chain=filtering.chain(),
        checked=not unchecked,
    )
    with progress_bar() as report:
        found = asbuilt.identify_channels(model, sensors, motors, options=options, progress=report)
    said = "".join(f"\n{wrapped(finding_text(each))}" for each in found.findings)
    answer(
        as_json,
        lambda: writers.channels_document(found),
        lambda: writers.channels_text(found, full) + said,
    )
