"""Commands about a robot: description, base parameters, views and exports."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, cast

import typer

import asbuilt
from asbuilt import (
    MotionError,
    ReadingOptions,
    RecordingError,
    excitation,
    experiment,
    writers,
)
from asbuilt.cli.answers import (
    answer,
    describe_cure,
    list_files,
    serve_page,
    show_progress,
)
from asbuilt.cli.arguments.options import (
    AS_IDENTIFIED,
    AsJson,
    Browser,
    Drive,
    FixedBase,
    Full,
    PagePort,
    Robot,
    RobotOrResult,
    is_result,
    load_robot_as_built,
    refuse_idle,
    require_writable_file,
    written_file,
)
from asbuilt.cli.arguments.spread import find_given_options
from asbuilt.codec import format_json
from asbuilt.description.load import BaseOptions, bundled_robot, robot_names
from asbuilt.description.structure.locking import locks_from_text
from asbuilt.experiment.logs.reading_options import parse_gravity
from asbuilt.tables import stack_tables


def robots(full: Full = False, as_json: AsJson = False) -> None:
    """List the bundled robots."""
    models = [bundled_robot(name) for name in robot_names()]
    answer(
        as_json,
        lambda: writers.robots_document(models),
        lambda: writers.robots_table(models).as_text(full),
    )


def drives(full: Full = False, as_json: AsJson = False) -> None:
    """List the drive terms that --drive takes, with their options."""
    answer(as_json, writers.drives_document, lambda: writers.drives_text(full))


def show(
    robot: RobotOrResult,
    *,
    root: BaseOptions,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Show geometry, mass properties, limits and the physical consistency of every link.

    For a result, it shows the robot as built, and CAD masses for comparison.
    """
    if not is_result(robot):
        model = root.load_robot(robot)
        answer(
            as_json,
            lambda: writers.robot_document(model),
            lambda: writers.robot_text(model, full, describe_cure),
        )
        return
    refuse_idle(AS_IDENTIFIED, find_given_options(root))
    result = asbuilt.read_result(Path(robot))

    model = writers.as_built(result).model
    masses = writers.exported_masses(result)
    answer(
        as_json,
        lambda: (
            writers.robot_document(model) | {"mass": None if masses is None else masses.as_dict()}
        ),
        lambda: (
            ("" if masses is None else writers.mass_table(masses).as_text(full) + "\n")
            + writers.robot_text(model, full, describe_cure)
        ),
    )


def schema(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="robot (robot file) or sheet (recording sheet)")
    ],
    out: Annotated[Path | None, written_file(text="file to write [default: print]")] = None,
    as_json: AsJson = False,
) -> None:
    """Print or write the JSON Schema of a file that people write.

    An editor then checks and completes it: its first line is `#:schema ./FILE`.
    """
    content = writers.json_schema(kind)
    files = {} if out is None else {"schema": writers.write_schema(kind, out)}
    answer(as_json, lambda: content, lambda: list_files(files) if files else format_json(content))


def base(
    robot: Robot,
    *,
    drive: Drive = None,
    root: BaseOptions,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Find the base parameters and which standard parameters of each link are identifiable.

    The full text says why, parameter by parameter.
    """
    from asbuilt.dynamics.drives.torque import keep_driven_joints

    model = root.load_robot(robot)
    chosen = asbuilt.DriveSet.parse(drive or model.usual_drive or "none")
    found = asbuilt.find_base_parameters(model, keep_driven_joints(model, chosen))
    standard = writers.standard_table if full else writers.identifiability_table
    answer(
        as_json,
        lambda: writers.base_document(found, model),
        lambda: stack_tables((writers.base_table(found, model), standard(found)), full),
    )


def view(
    robot: RobotOrResult,
    motion: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MOTION]", help="motion as CSV (t, q_*, ...), or any recording, to play"
        ),
    ] = None,
    *,
    save: Annotated[
        Path | None,
        written_file(
            "--save",
            text="write a page (.html), a picture (.png) or an animation (.gif, .webp) instead",
        ),
    ] = None,
    port: PagePort = 8080,
    browser: Browser = True,
    reading: ReadingOptions,
    as_json: AsJson = False,
) -> None:
    """Show the robot in 3-D in the browser, or save a picture, an animation or a page.

    The browser shows frames, centres of mass and inertia ellipsoids; Ctrl-C ends it.
    """
    model = load_robot_as_built(robot, fixed_base=reading.fixed_base)
    moved = None if motion is None else _read_motion(model, motion, reading)
    about = {"robot": model.name, "duration": None if moved is None else moved.duration}
    with show_progress() as report:
        shown = asbuilt.view_robot(
            model,
            moved,
            save=save,
            port=port,
            progress=lambda done: report("draw", done),
        )
    if isinstance(shown, Path):
        files = {"page" if shown.suffix.lower() == ".html" else "picture": shown}
        answer(as_json, lambda: writers.with_files(about, files), lambda: list_files(files))
        return
    try:
        answer(
            as_json,
            lambda: {**about, "url": shown.url},
            lambda: f"{model.name} at {shown.url}; Ctrl-C ends it",
        )
        serve_page(shown.url, shown.serve, browser=browser)
    finally:
        shown.close()


def _read_motion(
    model: asbuilt.RobotModel, path: Path, reading: ReadingOptions
) -> excitation.Motion:
    """Return the motion of a motion file, or of a recording in any format."""
    options = replace(reading, fixed_base=False)

    def logged() -> excitation.Motion:
        (recording,) = asbuilt.as_recordings(model, path, options)
        return writers.motion_of_recording(
            cast("asbuilt.Recording | experiment.RecordingStream", recording)
        )

    try:
        if path.suffix.lower() == ".csv" and not any(find_given_options(options).values()):
            return asbuilt.read_motion(path, model)
    except MotionError as problem:
        with suppress(RecordingError):
            return logged()
        raise problem from None
    return logged()


def convert(
    robot: Robot,
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="file to write: .toml, .urdf, or .xml (MJCF)"),
    ],
    lock: Annotated[
        str | None,
        typer.Option(
            "--lock",
            metavar="JOINT[=VALUE],...",
            help="joints to merge as fixed, at a position [rad or m; default: 0]",
        ),
    ] = None,
    gravity: Annotated[
        str | None,
        typer.Option(
            "--gravity",
            metavar="X,Y,Z",
            help="free fall in the root frame [m/s^2], or its axis such as -z",
        ),
    ] = None,
    fixed_base: FixedBase = False,
    as_json: AsJson = False,
) -> None:
    """Write a robot description in another format.

    A robot file (.toml) also holds gravity, couplings of motors and drives, which can be added
    there by hand. What the format cannot hold is listed; shapes and meshes are left out.
    """
    model = asbuilt.load_robot(robot, fixed_base=fixed_base)
    if lock is not None:
        model = model.locked(locks_from_text(lock))
    if gravity is not None:
        model = model.with_gravity(parse_gravity(gravity))
    converted = asbuilt.convert_robot(model, require_writable_file(out) or out)
    answer(as_json, converted.as_document, converted.as_text)
