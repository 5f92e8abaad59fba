"""Commands about a robot: description, base parameters, views and exports."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

import asbuilt
from asbuilt import MotionError, ReadingOptions, RecordingError, UsageError, writers
from asbuilt.cli.answers import answer, listed_files, progress_bar
from asbuilt.cli.arguments.options import (
    AsJson,
    Browser,
    Contacts,
    Drive,
    FixedBase,
    FreeBase,
    Full,
    Out,
    PagePort,
    Processes,
    Result,
    Robot,
    RobotOrResult,
    Scheduler,
    Seed,
    described_robot,
    refuse_idle,
    refuse_sharing,
    robot_as_built,
    shared_work,
    writable_file,
)
from asbuilt.cli.arguments.spread import given_options

if TYPE_CHECKING:
    from asbuilt.excitation.motions.motion import Motion
    from asbuilt.executor import Workers
    from asbuilt.experiment.logs.long_recordings import RecordingStream


def robots(full: Full = False, as_json: AsJson = False) -> None:
    """List the bundled robots."""
    from asbuilt.description.catalogue import bundled_robot, robot_names

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
    fixed_base: FixedBase = False,
    free_base: FreeBase = False,
    contacts: Contacts = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Show geometry, mass properties, limits and the physical consistency of every link.

    Of a result, those of the robot as built, masses of CAD beside them.
    """
    if Path(robot).suffix.lower() != ".json":
        model = described_robot(
            robot, fixed_base=fixed_base, free_base=free_base, contacts=contacts
        )
        answer(
            as_json, lambda: writers.robot_document(model), lambda: writers.robot_text(model, full)
        )
        return
    refuse_idle(
        "the robot of a result is taken as it was identified",
        {
            "--fixed-base": fixed_base,
            "--free-base": free_base,
            "--contacts": contacts is not None,
        },
    )
    result = asbuilt.read_result(Path(robot))

    model, masses = writers.as_built_model(result), writers.exported_masses(result)
    answer(
        as_json,
        lambda: (
            writers.robot_document(model) | {"mass": None if masses is None else masses.as_dict()}
        ),
        lambda: (
            ("" if masses is None else writers.mass_table(masses).as_text(full) + "\n")
            + writers.robot_text(model, full)
        ),
    )


def schema(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="robot (robot file) or sheet (recording sheet)")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="file to write [default: print]",
            callback=writable_file,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print or write the JSON Schema of a file that people write.

    An editor then checks and completes it: its first line is `#:schema ./FILE`.
    """
    from asbuilt.codec import json_text

    content = writers.json_schema(kind)
    files = {} if out is None else {"schema": writers.write_schema(kind, out)}
    text = listed_files(files) if files else json_text(content)
    answer(as_json, lambda: content, lambda: text)


def base(
    robot: Robot,
    drive: Drive = None,
    fixed_base: FixedBase = False,
    free_base: FreeBase = False,
    contacts: Contacts = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Find the base parameters and which standard parameters of each link are identifiable.

    The full text says why, parameter by parameter.
    """
    from asbuilt.dynamics.drives.defaults import on_driven_joints
    from asbuilt.tables import stacked

    model = described_robot(robot, fixed_base=fixed_base, free_base=free_base, contacts=contacts)
    chosen = asbuilt.DriveSet.parse(drive or model.usual_drive or "none")
    found = asbuilt.find_base_parameters(model, on_driven_joints(model, chosen))
    standard = writers.standard_table if full else writers.identifiability_table
    answer(
        as_json,
        lambda: writers.base_document(found, model),
        lambda: stacked((writers.base_table(found, model), standard(found)), full),
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
        typer.Option(
            "--save",
            metavar="FILE",
            help=("write a page (.html), a picture (.png) or an animation (.gif, .webp) instead"),
            callback=writable_file,
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
    model = robot_as_built(robot, fixed_base=reading.fixed_base)
    moved = None if motion is None else _played(model, motion, reading)
    about = {"robot": model.name, "duration": None if moved is None else moved.duration}
    with progress_bar() as report:
        shown = asbuilt.view_robot(
            model,
            moved,
            save=save,
            port=port,
            progress=lambda done: report("draw", done),
        )
    if isinstance(shown, Path):
        files = {"page" if shown.suffix.lower() == ".html" else "picture": shown}
        paths = {kind: str(path) for kind, path in files.items()}
        answer(as_json, lambda: {**about, "files": paths}, lambda: listed_files(files))
        return
    try:
        answer(
            as_json,
            lambda: {**about, "url": shown.url},
            lambda: f"{model.name} at {shown.url}; Ctrl-C ends it",
        )
        if browser:
            import webbrowser

            webbrowser.open(shown.url)
        with suppress(KeyboardInterrupt):
            shown.serve()
    finally:
        shown.close()


def _played(model: asbuilt.RobotModel, path: Path, reading: ReadingOptions) -> Motion:
    """Return the motion of a motion file, or of a recording in any format."""
    options = replace(reading, fixed_base=False)

    def logged() -> Motion:
        (recording,) = asbuilt.as_recordings(model, path, options)
        return writers.motion_of_recording(cast("asbuilt.Recording | RecordingStream", recording))

    try:
        if path.suffix.lower() == ".csv" and not any(given_options(options).values()):
            return asbuilt.read_motion(path, model)
    except MotionError as problem:
        with suppress(RecordingError):
            return logged()
        raise problem from None
    return logged()


def export(
    result: Result,
    urdf: Annotated[
        Path | None,
        typer.Option(
            "--urdf",
            metavar="FILE",
            help="URDF, the original as built; with --ensemble alone: URDF in place of MJCF",
        ),
    ] = None,
    mjcf: Annotated[
        Path | None, typer.Option("--mjcf", metavar="FILE", help="MJCF, for MuJoCo")
    ] = None,
    toml: Annotated[
        Path | None, typer.Option("--toml", metavar="FILE", help="robot file of asbuilt")
    ] = None,
    c: Annotated[
        Path | None,
        typer.Option("--c", metavar="FILE", help="C99 code FILE.c, and FILE.h beside it"),
    ] = None,
    observer: Annotated[
        Path | None,
        typer.Option(
            "--observer",
            metavar="FILE",
            help="C99 code FILE.c and FILE.h of the momentum observer and the dynamics it needs",
        ),
    ] = None,
    thresholds: Annotated[
        Path | None,
        typer.Option(
            "--thresholds",
            metavar="FILE",
            help="thresholds.json of `asbuilt watch`, for --observer",
        ),
    ] = None,
    original: Annotated[
        Path | None,
        typer.Option(
            "--original",
            metavar="FILE",
            help="URDF to edit [default: that of the robot]",
        ),
    ] = None,
    nearest: Annotated[
        bool,
        typer.Option(
            "--nearest",
            help=(
                "if the identified parameters are physically inconsistent, write the nearest"
                " consistent model"
            ),
        ),
    ] = False,
    force: Annotated[
        bool,
        typer.Option("--force", help="with --nearest: write it however large its error"),
    ] = False,
    elastic: Annotated[
        bool,
        typer.Option(
            "--elastic",
            help="in MJCF, a joint each for motor and link where two encoders show the stiffness",
        ),
    ] = False,
    to: Annotated[
        list[str] | None,
        typer.Option(
            "--to",
            metavar="FORMAT=FILE",
            help="for a simulator: isaac-lab, usd, mjlab, bam or ros2-control; repeat for more",
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
    workers: Processes = None,
    scheduler: Scheduler = None,
    out: Out = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Write the identified robot for other software.

    With --ensemble: many robots that the recordings allow, for domain randomization.
    """
    bare = urdf == Path()
    if ensemble is not None:
        others = {"--mjcf": mjcf, "--toml": toml, "--c": c, "--original": original}
        refuse_idle(
            "an ensemble is a set of MJCF or URDF files in one folder",
            {name: given is not None for name, given in others.items()}
            | {"--urdf FILE": urdf is not None and not bare, "--nearest": nearest}
            | {"--force": force, "--to": bool(to), "--observer": observer is not None}
            | {"--elastic": elastic},
        )
        with shared_work(workers, scheduler) as shared:
            models: Literal["mjcf", "urdf"] = "urdf" if bare else "mjcf"
            _export_ensemble(
                asbuilt.read_result(result), ensemble, models, seed, out, shared, full=full,
                as_json=as_json,
            )  # fmt: skip
        return
    refuse_sharing("only the draws of an ensemble are shared", workers, scheduler)
    if bare:
        raise UsageError("--urdf needs the name of a file, or --ensemble N")
    refuse_idle("files are named one by one without --ensemble", {"--out": out is not None})
    places, identified = _places(to or []), asbuilt.read_result(result)

    exported = asbuilt.export_result(
        identified,
        urdf=urdf,
        mjcf=mjcf,
        toml=toml,
        c=c,
        observer=observer,
        thresholds=None if thresholds is None else asbuilt.read_thresholds(thresholds),
        original=original,
        nearest=nearest,
        force=force,
        simulators=places,
        elastic=elastic,
    )
    answer(as_json, exported.as_document, exported.as_text)


def _places(to: list[str]) -> dict[str, Path]:
    """Return the file of each simulator format, from FORMAT=FILE."""
    places: dict[str, Path] = {}
    for each in to:
        key, equals, place = each.partition("=")
        if not equals or not place:
            raise UsageError(f"--to takes FORMAT=FILE, got {each!r}", value=each)
        if key in places:
            raise UsageError(f"--to {key} is given twice", value=each)
        places[key] = Path(place)
    return places


def _export_ensemble(
    result: asbuilt.IdentificationResult,
    n: int,
    models: Literal["mjcf", "urdf"],
    seed: int,
    out: Path | None,
    workers: Workers | None,
    *,
    full: bool,
    as_json: bool,
) -> None:

    if out is None:
        raise UsageError("an ensemble is a folder of files; name it with --out DIR")
    drawn = asbuilt.draw_ensemble(result, n, rng=seed, workers=workers)
    written = asbuilt.write_ensemble(out, drawn, models=models, seed=seed)
    answer(as_json, written.as_document, lambda: written.as_text(full))


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
    from asbuilt.description.structure.locking import locks_from_text
    from asbuilt.experiment.logs.options import gravity_of

    model = described_robot(robot, fixed_base=fixed_base)
    if lock is not None:
        model = model.locked(locks_from_text(lock))
    if gravity is not None:
        model = model.with_gravity(gravity_of(gravity))
    converted = asbuilt.convert_robot(model, writable_file(out) or out)
    answer(as_json, converted.as_document, converted.as_text)
