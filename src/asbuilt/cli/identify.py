"""Commands that identify a robot, and judge and use what was identified."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import asbuilt
from asbuilt import ReadingOptions, UsageError
from asbuilt.cli.answers import answer, brief_files, cure_text, listed_files, progress_bar
from asbuilt.cli.arguments.options import (
    AsJson,
    Filtering,
    Full,
    Judges,
    Logs,
    Out,
    Processes,
    Result,
    Robot,
    Scheduler,
    Unchecked,
    described_robot,
    distinct_logs,
    recordings_of,
    refuse_idle,
    refuse_sharing,
    robot_and_recordings,
    shared_work,
    writable_file,
)
from asbuilt.cli.arguments.spread import given_options
from asbuilt.cli.arguments.timelines import TimelineFiles
from asbuilt.tables import wrapped
from asbuilt.workflow.options import (
    AUTOMATIC,
    BLOCKS,
    ROLLOUT,
    ControllerOptions,
    PayloadOptions,
    StudyOptions,
    ValidationOptions,
    horizons,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from asbuilt.executor import Workers
    from asbuilt.validation.comparison.drift import Drift
    from asbuilt.workflow.controller_model import ControllerComparison


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
    workers: Processes = None,
    scheduler: Scheduler = None,
    reading: ReadingOptions,
    filtering: Filtering,
    timelines: TimelineFiles,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Identify a robot from recordings, and validate the result."""
    distinct_logs(log, validate, payload)
    if not options.rollout:
        refuse_sharing("only rollouts are shared", workers, scheduler)
    model, swept = described_robot(robot, **reading.of_base), filtering.cutoff == "auto"
    chain = replace(filtering, cutoff=None if swept else filtering.cutoff).chain()
    options = replace(options, chain=chain, sweep_cutoff=swept)
    with progress_bar() as report, shared_work(workers, scheduler) as shared:
        report("read", 0.0)
        model, (recordings, others, loaded) = robot_and_recordings(
            model, reading, log, validate, payload
        )
        from asbuilt.writers.reports.study_files import study_document, study_text, write_study

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
            under_load = PayloadOptions(chain=chain, holdout=held, checked=options.checked)
            carried = asbuilt.identify_payload(study.result, loaded, options=under_load)
        files, notes = (
            write_study(out, study, payload=carried, command=sys.argv[1:])
            if out is not None
            else ({}, {})
        )
        files |= timelines.write_validations(
            study.result.model,
            study.validations or study.training,
            [*recordings, *others],
            study.findings,
        )
    answer(
        as_json,
        lambda: study_document(study, files, notes, carried),
        lambda: (
            study_text(study, carried, full=full, cure_text=cure_text)
            + (
                listed_files(files, notes)
                if full
                else brief_files(files, _next_command(study, robot, files))
            )
        ),
    )


ANOTHER_MOTION = ("nothing_held_out", "held_out_repeats", "nothing_simulated")
MORE_MOTION = ("does_not_generalise", "not_excited")
"""Reasons of a verdict that another log, or a designed motion, takes away."""


def _next_command(study: asbuilt.Study, robot: str, files: Mapping[str, Path]) -> str:
    """Return the command that follows from the verdict on a study."""
    place, reasons = files.get("result"), study.verdict.reasons
    if place is None:
        return "the same with --out DIR, which writes report, robot and result"
    if study.verdict.use == "no":
        return f"asbuilt check {robot} LOG, and the findings above"
    if set(reasons) & set(ANOTHER_MOTION):
        return f"asbuilt validate {place} LOG of another motion"
    if set(reasons) & set(MORE_MOTION):
        return f"asbuilt excite {robot}, which designs a motion to record"
    if reasons:
        return f"asbuilt compare {place}, which says where it differs from CAD"
    return f"asbuilt export {place} --mjcf robot.xml (or --urdf, --c)"


def validate(
    result: Annotated[
        str,
        typer.Argument(
            metavar="RESULT|ROBOT",
            help="a result.json that `asbuilt identify --out` wrote, or a robot as described",
        ),
    ],
    log: Logs,
    *,
    rollout: Annotated[
        str | None,
        typer.Option("--rollout", metavar="LIST", help=ROLLOUT["help"]),
    ] = None,
    animation: Annotated[
        Path | None,
        typer.Option(
            "--animation",
            metavar="FILE",
            help="measured and simulated motion of the longest rollout as .webp or .gif",
            callback=writable_file,
        ),
    ] = None,
    require: Annotated[
        bool,
        typer.Option("--require", help="exit with status 1 if the model predicts worse than CAD"),
    ] = False,
    unchecked: Unchecked = False,
    workers: Processes = None,
    scheduler: Scheduler = None,
    reading: ReadingOptions,
    filtering: Filtering,
    timelines: TimelineFiles,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Predict recordings with an identified model, and with CAD beside it."""
    distinct_logs(log)
    if rollout is None:
        refuse_idle("--animation shows a rollout", {"--animation": animation is not None})
        refuse_sharing("only rollouts are shared", workers, scheduler)
    options = ValidationOptions(
        chain=filtering.chain() if any(filtering.given.values()) else None,
        rollout=() if rollout is None else horizons(rollout),
        checked=not unchecked,
    )
    if Path(result).suffix.lower() != ".json":
        refuse_idle(
            "--require compares an identified model with CAD; a robot as described is CAD",
            {"--require": require},
        )
        refuse_idle("timelines show the predictions of a result", given_options(timelines))
        with shared_work(workers, scheduler) as shared:
            _validate_described(
                result, log, options, reading, out, animation, shared, full=full, as_json=as_json
            )
        return
    identified = asbuilt.read_result(Path(result))
    if options.chain is not None and filtering.delay is None and identified.chain is not None:
        kept = replace(options.chain, delay=identified.chain.delay)
        options = replace(options, chain=kept)
    logged = recordings_of(identified.model, log, reading)
    from asbuilt.validation.generalisation.cad_verdict import cad_verdict
    from asbuilt.workflow.validation import validation_verdict
    from asbuilt.writers.reports.rollout_page import write_rollouts
    from asbuilt.writers.reports.study_files import write_validations
    from asbuilt.writers.tables.rollout_tables import rollout_text, with_rollouts
    from asbuilt.writers.tables.tabular import validate_document

    validations = asbuilt.validate(identified, logged, options=options)
    with shared_work(workers, scheduler) as shared:
        simulated = asbuilt.roll_out_result(
            identified, logged, options.rollout, options=options, workers=shared
        )
    files = write_validations(out, identified, validations) if out is not None else {}
    files |= write_rollouts(identified.model, simulated, out, animation)
    files |= timelines.write_validations(identified.model, validations, logged)
    comparison = asbuilt.compare(identified, validation=validations)
    verdicts = [cad_verdict(validation) for validation in validations]
    found = validation_verdict(identified, logged, validations, simulated)
    answer(
        as_json,
        lambda: with_rollouts(
            validate_document(identified, validations, files=files, verdict=found), simulated
        ),
        lambda: (
            wrapped(found.text)
            + "\n\n"
            + comparison.torque_table().as_text(full)
            + "\n"
            + "\n".join(wrapped(each.sentence) for each in verdicts)
            + "\n"
            + wrapped(comparison.verdict())
            + ("\n" if simulated else "")
            + rollout_text(identified.model, simulated, full=full, cure_text=cure_text)
            + listed_files(files)
        ),
    )
    if require and any(verdict.is_worse for verdict in verdicts):
        raise typer.Exit(1)


def _validate_described(
    robot: str,
    log: list[Path],
    options: ValidationOptions,
    reading: ReadingOptions,
    out: Path | None,
    animation: Path | None,
    workers: Workers | None,
    *,
    full: bool,
    as_json: bool,
) -> None:
    """Predict recordings with a robot as described."""
    if out is not None and not options.rollout:
        raise UsageError(
            "--out writes the predictions of a result; for a robot as described there is only"
            " the table, and a page of its rollouts (--rollout)"
        )
    model, (logged,) = robot_and_recordings(described_robot(robot, **reading.of_base), reading, log)
    from asbuilt.workflow.servo import has_open_servo
    from asbuilt.writers.files import path_texts
    from asbuilt.writers.reports.rollout_page import write_rollouts
    from asbuilt.writers.tables.rollout_tables import rollout_text, with_rollouts
    from asbuilt.writers.tables.tabular import described_document, described_torque_table

    # Where a log has neither torque nor gains, simulated motion is all there is to compare.
    with_torque = [each for each in logged if not (options.rollout and has_open_servo(each))]
    errors = asbuilt.validate_robot(model, with_torque, options=options) if with_torque else ()
    simulated = asbuilt.roll_out_robot(
        model, logged, options.rollout, options=options, workers=workers
    )
    files = write_rollouts(model, simulated, out, animation)
    answer(
        as_json,
        lambda: (
            with_rollouts(described_document(model, errors), simulated)
            | ({"files": path_texts(files)} if files else {})
        ),
        lambda: (
            (described_torque_table(model, errors).as_text(full) if errors else "")
            + rollout_text(model, simulated, full=full, cure_text=cure_text)
            + (listed_files(files) if files else "")
        ),
    )


def compare(
    result: Result,
    *,
    cad: Annotated[
        str | None,
        typer.Option(
            "--cad", metavar="ROBOT", help="another description of the same robot to compare with"
        ),
    ] = None,
    cad_tolerance: Annotated[
        str | None,
        typer.Option(
            "--cad-tolerance",
            metavar="5%",
            help="tolerance of CAD masses, centres and inertias: one fraction or three",
        ),
    ] = None,
    other: Annotated[
        Path | None,
        typer.Option(
            "--with",
            metavar="RESULT2",
            help="a later result of the same robot: what changed since RESULT",
        ),
    ] = None,
    controller: Annotated[
        Path | None,
        typer.Option(
            "--controller",
            metavar="LOG",
            help="a recording with tau_ext: compare with the controller's own model",
        ),
    ] = None,
    holdout: Annotated[
        str | None,
        typer.Option(
            "--holdout",
            metavar="RULE",
            help="what of --controller to validate on (default: blocks:5s:3)",
        ),
    ] = None,
    unchecked: Unchecked = False,
    reading: ReadingOptions,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Compare CAD with the robot as built.

    What differs, what that costs in torque, which causes explain it; or two results of one robot.
    """
    identified, files = asbuilt.read_result(result), {}
    if sum(choice is not None for choice in (cad, other, controller)) > 1:
        raise UsageError(
            "--cad, --with and --controller are three different comparisons; give one of them"
        )
    if controller is None:
        refuse_idle(
            "how a log is read, and what of it is held out, goes with --controller LOG",
            {"--holdout": holdout is not None, "--unchecked": unchecked} | given_options(reading),
        )
    if other is not None or controller is not None:
        refuse_idle(
            "tolerances are those of CAD, with which --with and --controller compare nothing",
            {"--cad-tolerance": cad_tolerance is not None},
        )
    recording = (
        None if controller is None else recordings_of(identified.model, [controller], reading)[0]
    )
    from asbuilt.identification.result.determination import determination
    from asbuilt.validation.comparison.cad_tolerance import CadTolerance
    from asbuilt.writers.reports.compare_files import (
        CadVerdict,
        with_files,
        write_comparison,
        write_drift,
    )

    drift: Drift | ControllerComparison | None = None
    if other is not None:
        later, names = asbuilt.read_result(other), (str(result), str(other))
        drift = asbuilt.compare_results(identified, later, labels=names)
    elif recording is not None:
        judged = ControllerOptions(holdout=holdout or BLOCKS, checked=not unchecked)
        drift = asbuilt.compare_controller(identified, recording, options=judged)
    if drift is not None:
        files = write_drift(out, drift) if out is not None else {}
        answer(
            as_json,
            lambda: with_files(drift.as_document(), files),
            lambda: drift.as_text(full) + listed_files(files),
        )
        return
    design = None if cad is None else described_robot(cad)
    if design is not None:
        held = identified.model.locked_joints.items()
        design = design.locked({name: at for name, at in held if name in design.joint_names})
    verdict = CadVerdict(
        asbuilt.compare(
            identified,
            design,
            tolerance=None if cad_tolerance is None else CadTolerance.parse(cad_tolerance),
        ),
        asbuilt.attribute(identified, design)
        if identified.cause_data is not None and not identified.model.n_floating
        else None,
        determination(identified),
    )
    files = write_comparison(out, identified, verdict) if out is not None else {}
    answer(
        as_json,
        lambda: with_files(verdict.as_document(), files),
        lambda: verdict.as_text(full) + listed_files(files),
    )
