"""Commands that identify a robot, and judge and use what was identified."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import asbuilt
from asbuilt import ReadingOptions, UsageError, writers
from asbuilt.cli.answers import answer, describe_cure, list_files, show_progress, summarise_files
from asbuilt.cli.arguments.options import (
    AsJson,
    Filtering,
    Full,
    Judges,
    Logs,
    Out,
    Result,
    Robot,
    Seed,
    Sharing,
    TimelineFiles,
    parse_places,
    read_robot_and_recordings,
    refuse_idle,
    require_distinct_logs,
)
from asbuilt.cli.arguments.spread import find_given_options
from asbuilt.ranges import option, switch
from asbuilt.workflow.study_options import (
    AUTOMATIC,
    PayloadOptions,
    StudyOptions,
)

if TYPE_CHECKING:
    from collections.abc import Mapping


def identify(
    robot: Robot,
    log: Logs,
    *,
    options: StudyOptions,
    validate: Judges = None,
    payload: Annotated[
        list[Path] | None,
        typer.Option(
            "--payload", metavar="LOG", help="a recording under load: what does the flange carry?"
        ),
    ] = None,
    sharing: Sharing,
    reading: ReadingOptions,
    filtering: Filtering,
    timelines: TimelineFiles,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Identify a robot from recordings, and validate the result."""
    require_distinct_logs(log, validate, payload)
    if not options.rollout:
        sharing.refuse("only rollouts are shared")
    model = reading.base.load_robot(robot)
    options = filtering.applied_to(options)
    with show_progress() as report, sharing.open() as shared:
        report("read", 0.0)
        model, (recordings, others, loaded) = read_robot_and_recordings(
            model, reading, log, validate, payload
        )

        study = asbuilt.identify(
            model,
            recordings,
            validation=others,
            options=options,
            workers=shared,
            progress=report,
        )
        carried = None
        if loaded:
            held = None if options.holdout == AUTOMATIC else options.holdout
            under_load = PayloadOptions(chain=options.chain, holdout=held, checked=options.checked)
            carried = asbuilt.identify_payload(study.result, loaded, options=under_load)
        files, notes = (
            writers.write_study(out, study, payload=carried, command=sys.argv[1:])
            if out is not None
            else ({}, {})
        )
        files |= timelines.write(
            lambda: writers.timelines_of_validations(
                study.result.model,
                study.validations or study.training,
                [*recordings, *others],
                study.findings,
            )
        )
    answer(
        as_json,
        lambda: writers.study_document(study, files, notes, carried),
        lambda: (
            writers.study_text(study, carried, full=full, cure_text=describe_cure)
            + (
                list_files(files, notes)
                if full
                else summarise_files(files, _suggest_next_command(study, robot, files))
            )
        ),
    )


ANOTHER_MOTION = ("nothing_held_out", "held_out_repeats", "nothing_simulated")
MORE_MOTION = ("does_not_generalise", "not_excited")
"""Reasons of a verdict that another log, or a designed motion, takes away."""


def _suggest_next_command(study: asbuilt.Study, robot: str, files: Mapping[str, Path]) -> str:
    """Return the command that follows from the verdict on a study."""
    place = files.get("result")
    reasons = study.verdict.reasons
    if place is None:
        return "the same with --out DIR, which writes report, robot and result"
    if study.verdict.use == "untested":
        return f"asbuilt validate {place} LOG of another motion"
    if study.verdict.use == "no":
        return f"asbuilt check {robot} LOG, and the findings above"
    if set(reasons) & set(ANOTHER_MOTION):
        return f"asbuilt validate {place} LOG of another motion"
    if set(reasons) & set(MORE_MOTION):
        return f"asbuilt excite {robot}, which designs a motion to record"
    if reasons:
        return f"asbuilt compare {place}, which says where it differs from CAD"
    return f"asbuilt export {place} --mjcf robot.xml (or --urdf, --c)"


@dataclass(frozen=True)
class ExportFiles:
    """The files that an export writes one by one, and how."""

    urdf: Path | None = option(
        None,
        "FILE",
        "URDF, the original as built; with --ensemble alone: URDF in place of MJCF",
    )
    mjcf: Path | None = option(None, "FILE", "MJCF, for MuJoCo")
    toml: Path | None = option(None, "FILE", "robot file of asbuilt")
    c: Path | None = option(None, "FILE", "C99 code FILE.c, with its header FILE.h")
    observer: Path | None = option(
        None,
        "FILE",
        "C99 code FILE.c and FILE.h of the momentum observer and the dynamics it needs",
    )
    thresholds: Path | None = option(
        None, "FILE", "thresholds.json of `asbuilt watch`, for --observer"
    )
    original: Path | None = option(None, "FILE", "URDF to edit [default: the robot's]")
    nearest: bool = switch(
        False,
        "if the identified parameters are physically inconsistent, write the nearest"
        " consistent model",
    )
    force: bool = switch(False, "with --nearest: write it however large its error")
    elastic: bool = switch(
        False, "in MJCF, a joint each for motor and link where two encoders show the stiffness"
    )


def export(
    result: Result,
    *,
    files: ExportFiles,
    to: Annotated[
        list[str] | None,
        typer.Option(
            "--to",
            metavar="FORMAT=FILE",
            help=(
                "isaac-lab, usd, mjlab, bam, ros2-control or ros2-inverse-dynamics; repeat for more"
            ),
        ),
    ] = None,
    ensemble: Annotated[
        int | None,
        typer.Option(
            "--ensemble",
            metavar="N",
            min=1,
            max=100_000,
            help="N robots drawn from the uncertainty, with their ranges; needs --out",
        ),
    ] = None,
    seed: Seed = 0,
    sharing: Sharing,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Write the identified robot for other software.

    With --ensemble: many robots that the recordings allow, for domain randomization.
    """
    bare = files.urdf == Path()
    if ensemble is not None:
        given = find_given_options(files)
        refuse_idle(
            "an ensemble is a set of MJCF or URDF files in one folder",
            {"--urdf FILE": given.pop("--urdf") and not bare, "--to": bool(to)} | given,
        )
        if out is None:
            raise UsageError("an ensemble is a folder of files; name it with --out DIR")
        identified = asbuilt.read_result(result)
        with sharing.open() as workers:
            drawn = asbuilt.draw_ensemble(identified, ensemble, rng=seed, workers=workers)
        written = asbuilt.write_ensemble(out, drawn, models="urdf" if bare else "mjcf", seed=seed)
        answer(as_json, written.as_document, lambda: written.as_text(full))
        return
    sharing.refuse("only the draws of an ensemble are shared")
    if bare:
        raise UsageError("--urdf needs the name of a file, or --ensemble N")
    refuse_idle("files are named one by one without --ensemble", {"--out": out is not None})
    places = parse_places(to)
    identified = asbuilt.read_result(result)
    exported = asbuilt.export_result(identified, **vars(files), simulators=places)
    answer(as_json, exported.as_document, exported.as_text)
