"""The command that identifies what the flange carries: payload."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import asbuilt
from asbuilt import PayloadOptions, ReadingOptions, writers
from asbuilt.cli.answers import answer, listed_files, progress_bar
from asbuilt.cli.arguments.options import (
    AsJson,
    Filtering,
    Full,
    Judges,
    Logs,
    Out,
    Result,
    distinct_logs,
    recordings_of,
)
from asbuilt.writers.files import with_files


def payload(
    result: Result,
    log: Logs,
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
    reading: ReadingOptions,
    filtering: Filtering,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Identify what the flange carries: mass, centre and inertia, from recordings under load."""
    distinct_logs(log, unloaded, validate)
    identified = asbuilt.read_result(result)
    loaded, bare, others = (
        recordings_of(identified.model, logs, reading) for logs in (log, unloaded, validate)
    )
    from asbuilt.identification.calibration.gain_uncertainty import parse_gain_uncertainty
    from asbuilt.workflow.calibration.payload_study import identify_moments, identify_payload

    options = replace(
        options,
        chain=filtering.chain(),
        gain_uncertainty=parse_gain_uncertainty(gain_uncertainty),
    )
    if moments:
        with progress_bar() as report:
            weight = identify_moments(
                identified, loaded, unloaded=bare, options=options, progress=report
            )
        document = writers.moments_document(weight)
        written = (
            {} if out is None else {"moments": writers.write_json(out / "moments.json", document)}
        )
        answer(
            as_json,
            lambda: with_files(document, written),
            lambda: writers.moments_table(weight).as_text(full) + listed_files(written),
        )
        return
    with progress_bar() as report:
        found = identify_payload(
            identified,
            loaded,
            unloaded=bare,
            validation=others,
            options=options,
            progress=report,
        )
    files = (
        {"payload": writers.write_json(out / "payload.json", writers.payload_document(found))}
        if out is not None
        else {}
    )
    answer(
        as_json,
        lambda: writers.payload_document(found, files),
        lambda: writers.payload_text(found, full) + listed_files(files),
    )
