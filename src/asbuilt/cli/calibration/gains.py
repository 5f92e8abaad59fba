"""The command that finds torques per ampere: gains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import GainOptions, ReadingOptions, writers
from asbuilt.cli.answers import answer, progress_bar
from asbuilt.cli.arguments.options import (
    AsJson,
    Carrier,
    Drive,
    Filtering,
    Full,
    Robot,
    Unchecked,
    described_robot,
    distinct_logs,
    number_list,
    robot_and_recordings,
)
from asbuilt.experiment.logs.readers import find_sheet


def gains(
    robot: Robot,
    log: Annotated[list[Path], typer.Argument(metavar="LOG...", help="recordings of the bare arm")],
    loaded: Annotated[
        list[Path],
        typer.Option(
            "--loaded", metavar="LOG", help="a recording with the payload; repeat for more"
        ),
    ],
    mass: Annotated[float, typer.Option("--mass", metavar="KG", help="mass of the payload")],
    *,
    com: Annotated[
        str | None,
        typer.Option(
            "--com", metavar="X,Y,Z", help="its centre of mass in the flange frame [m], if known"
        ),
    ] = None,
    frame: Carrier = None,
    drive: Drive = None,
    unchecked: Unchecked = False,
    reading: ReadingOptions,
    filtering: Filtering,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Find the torque per ampere (per logged unit) of every drive from a payload of known mass.

    The command prints the --gain that uses it. Gains of a sheet or of --gain scale the torques as
    usual; the gains printed replace them. In logs of commands the gain is the stiffness of the
    position servo, --kp.
    """
    distinct_logs(log, loaded)
    options = GainOptions(
        com=number_list("--com", com, 3) or None,
        frame=frame,
        drive=None if drive is None else asbuilt.DriveSet.parse(drive),
        chain=filtering.chain(),
        checked=not unchecked,
    )
    model = described_robot(robot, **reading.of_base)
    source = reading.torque_source or find_sheet(log[0], reading.sheet)[0].torque_source
    measured = replace(reading, torque_source=source or "current")
    model, (bare, under) = robot_and_recordings(model, measured, log, loaded)

    with progress_bar() as report:
        found = asbuilt.find_gains(model, bare, under, mass=mass, options=options, progress=report)
    answer(as_json, lambda: writers.gains_document(found), lambda: writers.gains_text(found, full))
