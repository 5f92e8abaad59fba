"""Commands that hold a model against recordings: validate, compare, review, watch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import asbuilt
from asbuilt import (
    ReadingOptions,
    StudyOptions,
    UsageError,
    identification,
    validation,
    workflow,
    writers,
)
from asbuilt.cli.answers import (
    answer,
    describe_cure,
    list_files,
    show_progress,
)
from asbuilt.cli.arguments.options import (
    RESULT_HELP,
    AsJson,
    Filtering,
    Full,
    Logs,
    Out,
    Result,
    Robot,
    Sharing,
    TimelineFiles,
    Unchecked,
    is_result,
    read_recordings_of_robot,
    read_robot_and_recordings,
    refuse_idle,
    require_distinct_logs,
    written_file,
)
from asbuilt.cli.arguments.spread import find_given_options, require_known_value
from asbuilt.tables import wrap_text
from asbuilt.workflow.study_options import (
    BLOCKS,
    ROLLOUT,
    ControllerOptions,
    ValidationOptions,
    parse_horizons,
)

if TYPE_CHECKING:
    from asbuilt.executor import Workers


def validate(
    result: Annotated[
        str,
        typer.Argument(
            metavar="RESULT|ROBOT",
            help=f"{RESULT_HELP}, or a robot as described",
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
        written_file(
            "--animation",
            text="measured and simulated motion of the longest rollout as .webp or .gif",
        ),
    ] = None,
    require: Annotated[
        bool,
        typer.Option("--require", help="exit with status 1 if the model predicts worse than CAD"),
    ] = False,
    unchecked: Unchecked = False,
    sharing: Sharing,
    reading: ReadingOptions,
    filtering: Filtering,
    timelines: TimelineFiles,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Predict recordings with an identified model, and with CAD for comparison."""
    require_distinct_logs(log)
    if rollout is None:
        refuse_idle("--animation shows a rollout", {"--animation": animation is not None})
        sharing.refuse("only rollouts are shared")
    options = ValidationOptions(
        chain=filtering.chain() if any(filtering.given.values()) else None,
        rollout=() if rollout is None else parse_horizons(rollout),
        checked=not unchecked,
    )
    if not is_result(result):
        refuse_idle(
            "--require compares an identified model with CAD; a robot as described is CAD",
            {"--require": require},
        )
        refuse_idle("timelines show the predictions of a result", find_given_options(timelines))
        with sharing.open() as shared:
            _validate_described(
                result, log, options, reading, out, animation, shared, full=full, as_json=as_json
            )
        return
    identified = asbuilt.read_result(Path(result))
    if options.chain is not None and filtering.delay is None and identified.chain is not None:
        options = replace(options, chain=replace(options.chain, delay=identified.chain.delay))
    logged = read_recordings_of_robot(identified.model, log, reading)
    from asbuilt.workflow.validation import decide_validation_verdict

    validations = asbuilt.validate(identified, logged, options=options)
    with sharing.open() as shared:
        simulated = asbuilt.roll_out_result(
            identified, logged, options.rollout, options=options, workers=shared
        )
    files = writers.write_validations(out, identified, validations) if out is not None else {}
    files |= writers.write_rollouts(identified.model, simulated, out, animation)
    files |= timelines.write(
        lambda: writers.timelines_of_validations(identified.model, validations, logged)
    )
    comparison = asbuilt.compare(identified, validation=validations)
    verdicts = [validation.cad_verdict(prediction) for prediction in validations]
    found = decide_validation_verdict(identified, logged, validations, simulated)
    answer(
        as_json,
        lambda: writers.with_rollouts(
            writers.validate_document(identified, validations, files=files, verdict=found),
            simulated,
        ),
        lambda: (
            wrap_text(found.text)
            + "\n\n"
            + comparison.torque_table().as_text(full)
            + "\n"
            + "\n".join(wrap_text(verdict.sentence) for verdict in verdicts)
            + "\n"
            + wrap_text(comparison.verdict())
            + ("\n" if simulated else "")
            + writers.rollout_text(identified.model, simulated, full=full, cure_text=describe_cure)
            + list_files(files)
            + _suggest_payload(result, log, validations)
        ),
    )
    if require and any(verdict.is_worse for verdict in verdicts):
        raise typer.Exit(1)


def _suggest_payload(
    result: str, log: Sequence[Path], validations: Sequence[validation.Validation]
) -> str:
    """Return the command that identifies a load which a recording carries; empty without one."""
    for path, each in zip(log, validations, strict=True):
        if each.load is not None and each.load.mass > 0.0:
            return f"\nNext: asbuilt payload {result} {path}"
    return ""


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
    model, (logged,) = read_robot_and_recordings(reading.base.load_robot(robot), reading, log)
    from asbuilt.workflow.torque_source import lacks_torque

    # Where a log has neither torque nor gains, simulated motion is all there is to compare.
    with_torque = [
        recording for recording in logged if not (options.rollout and lacks_torque(recording))
    ]
    errors = asbuilt.validate_robot(model, with_torque, options=options) if with_torque else ()
    simulated = asbuilt.roll_out_robot(
        model, logged, options.rollout, options=options, workers=workers
    )
    files = writers.write_rollouts(model, simulated, out, animation)
    answer(
        as_json,
        lambda: writers.with_files(
            writers.with_rollouts(writers.described_document(model, errors), simulated), files
        ),
        lambda: (
            (writers.described_torque_table(model, errors).as_text(full) if errors else "")
            + writers.rollout_text(model, simulated, full=full, cure_text=describe_cure)
            + list_files(files)
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
    identified = asbuilt.read_result(result)
    files = {}
    if sum(choice is not None for choice in (cad, other, controller)) > 1:
        raise UsageError(
            "--cad, --with and --controller are three different comparisons; give one of them"
        )
    if controller is None:
        refuse_idle(
            "how a log is read, and what of it is held out, goes with --controller LOG",
            {"--holdout": holdout is not None, "--unchecked": unchecked}
            | find_given_options(reading),
        )
    if other is not None or controller is not None:
        refuse_idle(
            "tolerances apply to CAD, with which --with and --controller compare nothing",
            {"--cad-tolerance": cad_tolerance is not None},
        )
    recording = (
        None
        if controller is None
        else read_recordings_of_robot(identified.model, [controller], reading)[0]
    )
    drift: validation.Drift | workflow.ControllerComparison | None = None
    if other is not None:
        later = asbuilt.read_result(other)
        names = (str(result), str(other))
        drift = asbuilt.compare_results(identified, later, labels=names)
    elif recording is not None:
        scoring = ControllerOptions(holdout=holdout or BLOCKS, checked=not unchecked)
        drift = asbuilt.compare_controller(identified, recording, options=scoring)
    if drift is not None:
        files = writers.write_drift(out, drift) if out is not None else {}
        answer(
            as_json,
            lambda: writers.with_files(drift.as_document(), files),
            lambda: drift.as_text(full) + list_files(files),
        )
        return
    from asbuilt.validation.attribution.attribute import can_attribute

    design = None if cad is None else asbuilt.load_robot(cad)
    if design is not None:
        held = identified.model.locked_joints.items()
        design = design.locked({name: at for name, at in held if name in design.joint_names})
    tolerance = None if cad_tolerance is None else validation.CadTolerance.parse(cad_tolerance)
    verdict = writers.CadVerdict(
        asbuilt.compare(identified, design, tolerance=tolerance),
        asbuilt.attribute(identified, design) if can_attribute(identified) else None,
        identification.determination(identified),
    )
    files = writers.write_comparison(out, identified, verdict) if out is not None else {}
    answer(
        as_json,
        lambda: writers.with_files(verdict.as_document(), files),
        lambda: verdict.as_text(full) + list_files(files),
    )


def feasible(
    result: Result,
    quantity: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[QUANTITY]...",
            help=(
                "mass, mass:LINK, com:LINK, Ixx:LINK, armature:JOINT, ..., without a place of all"
                " links or joints [default: masses and armatures]"
            ),
        ),
    ] = None,
    *,
    prior: Annotated[
        str | None,
        typer.Option("--prior", metavar="cad", help="masses of links are near CAD"),
    ] = None,
    cad_tolerance: Annotated[
        str | None,
        typer.Option(
            "--cad-tolerance",
            metavar="20%",
            help="how near CAD the masses are, with --prior cad [default: 20%]",
        ),
    ] = None,
    geometry: Annotated[
        bool,
        typer.Option(
            "--geometry",
            help="links lie within the boxes around their shapes in the URDF, no denser than steel",
        ),
    ] = False,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Find the least and greatest value of quantities that torques need not determine.

    Over all physically consistent bodies whose base parameters lie within the 95 % region of the
    estimate, with what was chosen for the exported robot, and what each is confounded with.
    """
    if prior is not None:
        require_known_value("--prior", prior, ("cad",))
    else:
        refuse_idle(
            "--cad-tolerance goes with --prior cad", {"--cad-tolerance": cad_tolerance is not None}
        )
    identified = asbuilt.read_result(result)
    condition = identified.result.torque_condition
    found = asbuilt.feasible_intervals(
        identified,
        quantity or (),
        prior="cad" if prior else None,
        tolerance=validation.CadTolerance.parse(cad_tolerance or "20%").mass,
        geometry=geometry,
    )
    answer(
        as_json,
        lambda: {
            "robot": identified.robot,
            "quantities": [interval.as_dict() for interval in found],
            "condition": condition,
        },
        lambda: writers.feasible_table(found, condition).as_text(full),
    )


def review(
    robot: Robot,
    log: Logs,
    *,
    cad_tolerance: Annotated[
        str | None,
        typer.Option(
            "--cad-tolerance",
            metavar="30%",
            help=(
                "plausible errors of masses, centres and inertias while another number is tested:"
                " one fraction or three"
            ),
        ),
    ] = None,
    options: StudyOptions,
    reading: ReadingOptions,
    filtering: Filtering,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Judge every number that a description claims by recordings.

    Armature, damping, friction loss, gains, masses, centres and inertias:
    supported, contradicted or undetermined, and what each is an alias of.
    """
    require_distinct_logs(log)
    model = reading.base.load_robot(robot)
    options = filtering.applied_to(options)
    with show_progress() as report:
        report("read", 0.0)
        model, (recordings,) = read_robot_and_recordings(model, reading, log)
        tolerance = {}
        if cad_tolerance is not None:
            tolerance["tolerance"] = validation.CadTolerance.parse(cad_tolerance)
        found = asbuilt.review(
            model,
            recordings,
            **tolerance,
            options=options,
            progress=report,
        )
        files = writers.write_review(out, found) if out is not None else {}
    answer(
        as_json,
        lambda: (
            writers.with_files(writers.review_document(found), files)
            if files
            else writers.review_document(found)
        ),
        lambda: (
            writers.review_text(found, full=full, cure_text=describe_cure).rstrip("\n")
            + list_files(files)
        ),
    )
