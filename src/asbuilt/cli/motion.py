"""Commands that design a motion and bring it to a controller."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import asbuilt
from asbuilt import DesignOptions, UsageError, excitation, writers
from asbuilt.cli.answers import answer, describe_cure, list_files, show_progress
from asbuilt.cli.arguments.options import (
    AsJson,
    FixedBase,
    Full,
    Robot,
    Sharing,
    refuse_both,
    refuse_idle,
    written_file,
)
from asbuilt.cli.arguments.spread import find_given_options

OF_MOTIONS = (
    *("--parametrisation", "--harmonics", "--criterion", "--focus", "--periods"),
    *("--power", "--perturbed", "--drive"),
)
"""Options that do not apply to static poses."""


def excite(
    robot: Robot,
    options: DesignOptions,
    given: Annotated[
        Path | None,
        typer.Option(
            "--given",
            metavar="RESULT",
            help="add to an earlier result, with its noise and drive terms",
        ),
    ] = None,
    static: Annotated[
        int | None,
        typer.Option(
            "--static", metavar="K", min=1, max=1000, help="K static poses for gravity, no motion"
        ),
    ] = None,
    rate: Annotated[
        float,
        typer.Option("--rate", metavar="HZ", min=0.1, max=1e5, help="rate of the motion file"),
    ] = 1000.0,
    program: Annotated[
        list[str] | None,
        typer.Option(
            "--program", metavar="FORMAT", help="also write a controller program; repeatable"
        ),
    ] = None,
    out: Annotated[Path, written_file(text="motion file to write")] = Path("motion.csv"),
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            metavar="N",
            min=1,
            max=1024,
            help="processes that search (default: one a core)",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Dask scheduler whose workers search too, such as tcp://10.0.0.1:8786",
        ),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="draw the motion on a page next to it")
    ] = True,
    fixed_base: FixedBase = False,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Design the most informative motion within the limits of a robot."""
    asked = find_given_options(options)
    refuse_both(workers, scheduler)
    if static is not None:
        Sharing(workers, scheduler).refuse("static poses are found by one process")
    _refuse_idle(asked, options, static=static is not None, given=given is not None)
    model = asbuilt.load_robot(robot, fixed_base=fixed_base)
    base = None
    prior = None
    from asbuilt.identification.result.as_built_parameters import known_information

    if given is not None:
        known = asbuilt.read_result(given)
        if known.model.joint_names != model.joint_names:
            raise UsageError(f"{given} belongs to {known.robot}, not to {model.name}")
        model = known.model
        base = known.base
        prior = known_information(known)
        if not asked["--noise"]:
            options = replace(options, noise=tuple(known.sigma.tolist()))
    family = "point-to-point" if static is not None else options.parametrisation
    for form in program or ():
        writers.PROGRAM_WRITERS.find("controller").check(form, model, family)

    with show_progress() as show:

        def progress(state: excitation.SearchProgress) -> None:
            best = f": best {state.best:.2f}" if math.isfinite(state.best) else ""
            show(state.phase + best, state.share)

        found: Any = (
            asbuilt.design_motion(
                model,
                options,
                base=base,
                prior=prior,
                cores=workers,
                scheduler=scheduler,
                progress=progress,
            )
            if static is None
            else asbuilt.design_static_poses(model, static, options)
        )
        files = {"motion": asbuilt.write_motion(out, found.motion, model.joint_names, rate)}
        files |= _write_programs(model, found.motion, program, out, options.collision)
        if report:
            files["report"] = writers.write_motion_report(out.with_suffix(".html"), found)
    answer(
        as_json,
        lambda: writers.design_document(found, files),
        lambda: writers.design_text(found, full=full, spell=describe_cure) + list_files(files),
    )


def _refuse_idle(
    asked: dict[str, bool], options: DesignOptions, *, static: bool, given: bool
) -> None:
    if static:
        why = "static poses are for gravity alone, and these options are for motions"
        refuse_idle(why, {option: asked[option] for option in OF_MOTIONS})
    if options.duration != "auto":
        refuse_idle("--precision needs --duration auto", {"--precision": asked["--precision"]})
    if given:
        why = "--given brings the drive terms of the earlier result"
        refuse_idle(why, {"--drive": asked["--drive"]})
    if not options.tool_box:
        refuse_idle("--tool-frame needs --tool-box", {"--tool-frame": asked["--tool-frame"]})


def _write_programs(
    model: asbuilt.RobotModel,
    motion: excitation.Motion,
    forms: Sequence[str] | None,
    out: Path,
    collision: str | None,
) -> dict[str, Path]:
    """Write the programs of a motion into folders next to its file."""
    files: dict[str, Path] = {}
    for form in forms or ():
        folder = out.with_name(f"{out.stem}_{form}")
        written = writers.PROGRAM_WRITERS.find("controller").write(
            folder, model, motion, form, name=out.stem, collision=collision
        )
        files |= {f"{form}_{role}": path for role, path in written.items()}
    return files
