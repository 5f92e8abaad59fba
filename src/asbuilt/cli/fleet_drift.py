"""Commands that compare the robots of a fleet with themselves and their siblings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt.cli.answers import answer, finding_text, listed_files, progress_bar
from asbuilt.cli.arguments.options import AsJson, Full, writable_folder
from asbuilt.cli.fleet import LedgerPlace
from asbuilt.workflow.fleet.options import FleetDriftOptions

ChangesSince = Annotated[
    str | None,
    typer.Option(
        "--since",
        metavar="DATE",
        help="look for changes on this date (UTC) or later; earlier logs are the reference",
    ),
]


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
    opened = asbuilt.open_ledger(ledger)
    from asbuilt.workflow.fleet.reduction.log_source import parse_date
    from asbuilt.writers.tables.fleet_tables import drift_text

    first = None if since is None else parse_date(since)
    with progress_bar() as report:
        found = asbuilt.fleet_drift(opened, since=first, options=options, progress=report)
    answer(as_json, found.as_document, lambda: drift_text(found, finding_text, full=full))


def report(
    ledger: LedgerPlace,
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="DIR", help="folder for the page", callback=writable_folder
        ),
    ],
    since: ChangesSince = None,
    options: FleetDriftOptions,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Write a page of a fleet: each robot's history, those that changed first.

    The page needs no server and no network.
    """
    opened = asbuilt.open_ledger(ledger)
    from asbuilt.workflow.fleet.reduction.log_source import parse_date
    from asbuilt.writers.tables.fleet_tables import drift_text

    first = None if since is None else parse_date(since)
    with progress_bar() as tell:
        found = asbuilt.fleet_drift(opened, since=first, options=options, progress=tell)
    files = {"report": asbuilt.write_fleet_report(out / "fleet.html", found)}
    answer(
        as_json,
        lambda: found.as_document() | {"files": {"report": str(files["report"])}},
        lambda: drift_text(found, finding_text, full=full) + listed_files(files),
    )
