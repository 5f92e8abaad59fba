"""Commands of fleets: many robots over time, kept as information in a ledger."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import (
    FleetDriftOptions,
    FleetIdentification,
    FleetOptions,
    ReadingOptions,
    StudyOptions,
    UsageError,
    writers,
)
from asbuilt.apps import fleet as app
from asbuilt.cli import (
    AsJson,
    Filtering,
    Full,
    Logs,
    Out,
    Robot,
    Unchecked,
    answer,
    describe_cure,
    list_files,
    out_folder,
    show_progress,
)

LedgerPlace = Annotated[
    str,
    typer.Argument(metavar="LEDGER", help="a folder, or a URL such as s3://bucket/ledger"),
]
RobotId = Annotated[str, typer.Option("--id", metavar="ID", help="identity of the robot")]
Since = Annotated[
    str | None,
    typer.Option("--since", metavar="DATE", help="logs of this date (UTC) or later"),
]
Until = Annotated[
    str | None, typer.Option("--until", metavar="DATE", help="logs before this date (UTC)")
]
Drive = Annotated[
    str | None,
    typer.Option(
        "--drive",
        metavar="LIST",
        help="drive terms of the type, or auto: chosen from its first log, then fixed",
    ),
]


def add(
    ledger: LedgerPlace,
    robot: Robot,
    log: Logs,
    *,
    id: Annotated[
        str | None, typer.Option("--id", metavar="ID", help="identity of the robot of all logs")
    ] = None,
    id_from: Annotated[
        str | None,
        typer.Option(
            "--id-from",
            metavar="PATTERN",
            help="identity from the path of each log: {id}/*.csv, *_{id}.parquet",
        ),
    ] = None,
    date: Annotated[
        str | None,
        typer.Option(
            "--date",
            metavar="DATE",
            help="when the logs began (UTC); else their sheets, time stamps or names say it",
        ),
    ] = None,
    fleet: FleetOptions,
    drive: Drive = None,
    unchecked: Unchecked = False,
    reading: ReadingOptions,
    filtering: Filtering,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Reduce logs to their information and append it to a ledger.

    Logs that are in the ledger are skipped, so an interrupted command is repeated as it was. A log
    that cannot be used is listed, the others are added, and the exit status is 1.
    """
    if (id is None) == (id_from is None):
        raise UsageError("give the identity of the robot by --id ID or by --id-from PATTERN")
    asked = _make_study_options(drive, unchecked, filtering)
    from asbuilt.apps.fleet.reduction.log_source import make_identity_finder

    identity = id if id is not None else make_identity_finder(str(id_from))
    with show_progress() as report:
        done = asbuilt.add_logs(
            ledger,
            robot,
            log,
            robot_id=identity,
            reading=reading,
            options=asked,
            fleet=fleet,
            date=_parse_date(date),
            progress=report,
        )
    _answer_addition(done, full, as_json)


def _answer_addition(done: app.Addition, full: bool, as_json: bool) -> None:
    """Print what was added; logs that failed are the exit status."""
    answer(
        as_json,
        lambda: app.addition_document(done),
        lambda: app.addition_text(done, describe_cure, full=full),
    )
    if done.failed:
        raise typer.Exit(1)


def rebuild(
    ledger: LedgerPlace,
    log: Logs,
    *,
    fleet: FleetOptions,
    drive: Drive = None,
    unchecked: Unchecked = False,
    reading: ReadingOptions,
    filtering: Filtering,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Reduce logs of a ledger again, with settings chosen from all.

    Robots and dates are known from the ledger. The old entries stay valid until all logs are done;
    logs that are not given are left out of the ledger from then on.
    """
    asked = _make_study_options(drive, unchecked, filtering)

    with show_progress() as report:
        done = asbuilt.rebuild_ledger(
            ledger,
            log,
            reading=reading,
            options=asked,
            fleet=fleet,
            progress=report,
        )
    _answer_addition(done, full, as_json)


def show(
    ledger: LedgerPlace,
    *,
    thorough: Annotated[
        bool,
        typer.Option(
            "--thorough", help="read every entry: durations, damaged files, odd logs of a robot"
        ),
    ] = False,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Show the robots of a ledger, their logs and settings."""
    seen = asbuilt.fleet_overview(ledger, thorough=thorough)
    answer(as_json, seen.as_document, lambda: app.overview_text(seen, describe_cure, full=full))


def identify(
    ledger: LedgerPlace,
    *,
    id: RobotId,
    since: Since = None,
    until: Until = None,
    options: FleetIdentification,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Identify a robot from the ledger alone, in any window of dates.

    It gives the parameters of `asbuilt identify` on the same logs with the same method, chain and
    drive terms.
    """
    study = asbuilt.fleet_identify(
        ledger,
        id,
        since=_parse_date(since),
        until=_parse_date(until),
        options=options,
    )
    files, notes = writers.write_study(out, study) if out is not None else ({}, {})
    answer(
        as_json,
        lambda: writers.study_document(study, files, notes) | {"id": id},
        lambda: (
            writers.study_text(study, full=full, cure_text=describe_cure) + list_files(files, notes)
        ),
    )


def _parse_date(text: str | None) -> datetime | None:
    """Return the date that a text names, None without a text."""
    from asbuilt.apps.fleet.reduction.log_source import parse_date

    return None if text is None else parse_date(text)


def _make_study_options(drive: str | None, unchecked: bool, filtering: Filtering) -> StudyOptions:
    if filtering.cutoff == "auto":
        raise UsageError("a ledger takes a cutoff in Hz, or the one chosen from the first log")
    return replace(
        StudyOptions(),
        drive=drive,
        chain=filtering.chain() if any(filtering.given.values()) else None,
        checked=not unchecked,
    )


ChangesSince = Annotated[
    str | None,
    typer.Option(
        "--since",
        metavar="DATE",
        help="look for changes on this date (UTC) or later; earlier logs are the reference",
    ),
]


def _find_drift(ledger: str, since: str | None, options: FleetDriftOptions) -> app.FleetDrift:
    with show_progress() as report:
        return asbuilt.fleet_drift(
            ledger, since=_parse_date(since), options=options, progress=report
        )


def drift(
    ledger: LedgerPlace,
    *,
    since: ChangesSince = None,
    options: FleetDriftOptions,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Find the robots of a fleet that changed: which, when, what and how large.

    Natural variation from day to day is estimated from all robots of a type.
    """
    found = _find_drift(ledger, since, options)
    answer(as_json, found.as_document, lambda: app.drift_text(found, describe_cure, full=full))


def report(
    ledger: LedgerPlace,
    *,
    out: Annotated[Path, out_folder("folder for the page")],
    since: ChangesSince = None,
    options: FleetDriftOptions,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Write a page of a fleet: each robot's history, those that changed first.

    The page needs no server and no network.
    """
    found = _find_drift(ledger, since, options)
    files = {"report": asbuilt.write_fleet_report(out / "fleet.html", found)}
    answer(
        as_json,
        lambda: found.as_document() | {"files": {"report": str(files["report"])}},
        lambda: app.drift_text(found, describe_cure, full=full) + list_files(files),
    )
