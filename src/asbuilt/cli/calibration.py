"""Commands that need a payload or a second channel of torques: channels, gains, payload."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import asbuilt
from asbuilt import (
    ChannelOptions,
    GainOptions,
    PayloadOptions,
    ReadingOptions,
    UsageError,
    writers,
)
from asbuilt.cli.answers import answer, describe_cure, list_files, show_progress
from asbuilt.cli.arguments.options import (
    AsJson,
    Carrier,
    Drive,
    Filtering,
    Full,
    Judges,
    Out,
    Robot,
    Unchecked,
    parse_number_list,
    parse_places,
    read_recordings_of_robot,
    read_robot_and_recordings,
    refuse_idle,
    require_distinct_logs,
)
from asbuilt.experiment.logs.readers import find_sheet
from asbuilt.findings import Cure, list_findings


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
                " the terms of coupled motors)"
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
    require_distinct_logs(log)
    require_distinct_logs(motor)
    if motor_sheet is None and motor_gain is None:
        require_distinct_logs(log, motor)
    model = reading.base.load_robot(robot)
    on_links = replace(reading, torque_source=reading.torque_source or "sensor")
    on_motors = replace(
        reading,
        gain=parse_number_list("--motor-gain", motor_gain) or None,
        torque_source="motor",
        sheet=motor_sheet or reading.sheet,
    )
    model, (sensors,) = read_robot_and_recordings(model, on_links, log)
    model, (motors,) = read_robot_and_recordings(model, on_motors, motor)

    options = ChannelOptions(
        link_side=None if drive is None else asbuilt.DriveSet.parse(drive),
        motor_side=None if motor_drive is None else asbuilt.DriveSet.parse(motor_drive),
        chain=filtering.chain(),
        checked=not unchecked,
    )
    with show_progress() as report:
        found = asbuilt.identify_channels(model, sensors, motors, options=options, progress=report)
    listed = list_findings(found.findings, describe_cure, full=full)
    messages = "".join(f"\n{line}" for line in listed)
    answer(
        as_json,
        lambda: writers.channels_document(found),
        lambda: writers.channels_text(found, full) + messages,
    )


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
    require_distinct_logs(log, loaded)
    options = GainOptions(
        com=parse_number_list("--com", com, 3) or None,
        frame=frame,
        drive=None if drive is None else asbuilt.DriveSet.parse(drive),
        chain=filtering.chain(),
        checked=not unchecked,
    )
    model = reading.base.load_robot(robot)
    source = reading.torque_source or find_sheet(log[0], reading.sheet)[0].torque_source
    measured = replace(reading, torque_source=source or "current")
    model, (bare, under) = read_robot_and_recordings(model, measured, log, loaded)

    with show_progress() as report:
        found = asbuilt.find_gains(model, bare, under, mass=mass, options=options, progress=report)
    answer(as_json, lambda: writers.gains_document(found), lambda: writers.gains_text(found, full))


def payload(
    result: Annotated[
        Path,
        typer.Argument(
            metavar="RESULT",
            help="a result.json of `asbuilt identify --out`; with --to alone: a payload.json",
        ),
    ],
    log: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG...", help="recordings under load"),
    ] = None,
    *,
    options: PayloadOptions,
    unloaded: Annotated[
        list[Path] | None,
        typer.Option(
            "--unloaded", metavar="LOG", help="a recording of the bare arm; repeat for more"
        ),
    ] = None,
    validate: Judges = None,
    moments: Annotated[
        bool,
        typer.Option(
            "--moments",
            help=(
                "a weight on any link (--frame): the change of first moments, with the mass if"
                " the motion determines it"
            ),
        ),
    ] = False,
    gain_uncertainty: Annotated[
        str | None,
        typer.Option(
            "--gain-uncertainty",
            metavar="7%|P1,P2,...",
            help=(
                "relative error of the torque per ampere, for all joints or each (default: 7% for"
                " currents, 5% for motor torques, 0 for sensors; more where gravity torques are"
                " far from CAD's)"
            ),
        ),
    ] = None,
    to: Annotated[
        list[str] | None,
        typer.Option(
            "--to",
            metavar="MAKER=FILE",
            help="in the maker's words: ur, franka, kuka, abb, fanuc, yaskawa, doosan or an"
            " installed one; repeat for more",
        ),
    ] = None,
    reading: ReadingOptions,
    filtering: Filtering,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Identify what the flange carries: mass, centre and inertia, from recordings under load.

    With --to and no recording: write a stored payload.json in the words of robot makers.
    """
    places = parse_places(to)
    for key in places:
        writers.PAYLOAD_FORMATS.find(key)
    refuse_idle("--moments finds no inertia, which makers ask for", {"--to": moments and bool(to)})
    if not log:
        _convert_stored_payload(result, places, as_json=as_json)
        return
    require_distinct_logs(log, unloaded, validate)
    identified = asbuilt.read_result(result)
    loaded, bare, others = (
        read_recordings_of_robot(identified.model, logs, reading)
        for logs in (log, unloaded, validate)
    )
    from asbuilt.identification.calibration.payload_rows import parse_gain_uncertainty
    from asbuilt.workflow.calibration import identify_moments

    options = replace(
        options,
        chain=filtering.chain(),
        gain_uncertainty=parse_gain_uncertainty(gain_uncertainty),
    )
    with show_progress() as report:
        found: Any = (
            identify_moments(identified, loaded, unloaded=bare, options=options, progress=report)
            if moments
            else asbuilt.identify_payload(
                identified,
                loaded,
                unloaded=bare,
                validation=others,
                options=options,
                progress=report,
            )
        )
    if moments:
        name = "moments"
        document = writers.moments_document(found)
        text = writers.moments_table(found).as_text(full)
    else:
        name = "payload"
        document = writers.payload_document(found)
        text = writers.payload_text(found, full)
    files, notes = writers.write_payload(found, places) if places else ({}, {})
    if out is not None:
        files = {name: writers.write_json(out / f"{name}.json", document)} | files
    answer(
        as_json,
        lambda: writers.with_files(document, files) | _document_notes(notes),
        lambda: text + list_files(files, notes),
    )


def _convert_stored_payload(stored: Path, places: Mapping[str, Path], *, as_json: bool) -> None:
    """Write a payload.json in the words of makers; raises `UsageError` on anything else."""
    body = writers.read_stored_payload(stored)
    if body is None:
        raise UsageError(
            f"{stored} needs recordings under load: asbuilt payload {stored} LOG...",
            cure=Cure("name them, or give a payload.json with --to MAKER=FILE"),
        )
    if not places:
        raise UsageError(
            f"{stored} is a payload; name what to write of it with --to MAKER=FILE",
            available=[*writers.PAYLOAD_FORMATS],
        )
    files, notes = writers.write_payload(body, places)
    document = {"robot": body.robot, "frame": body.frame, "mass": {"estimate": body.mass}}
    answer(
        as_json,
        lambda: writers.with_files(document, files) | _document_notes(notes),
        lambda: f"{body.robot}: payload of {body.mass:.4g} kg" + list_files(files, notes),
    )


def _document_notes(notes: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    return {"notes": {key: list(lines) for key, lines in notes.items()}} if notes else {}
