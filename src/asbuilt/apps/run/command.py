"""The command `asbuilt run`."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import asbuilt
from asbuilt import UsageError, writers
from asbuilt.apps.run.options import RunOptions
from asbuilt.cli import (
    AsJson,
    Robot,
    describe_cure,
    load_described_robot,
    print_text,
    show_progress,
    summarise_files,
)
from asbuilt.cli import require_writable_folder as require_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from asbuilt.apps.run.drivers import Driver
    from asbuilt.apps.run.loop import Loop, Outcome
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

FOLDER = Path("asbuilt-run")


def run(
    robot: Robot,
    options: RunOptions,
    on: Annotated[
        str | None,
        typer.Option(
            "--on",
            metavar="DRIVER",
            help="what moves the robot: virtual[:PRESET], files:DIR or an installed one",
        ),
    ] = None,
    motion: Annotated[
        Path | None,
        typer.Option(
            "--motion",
            metavar="FILE",
            help="motion CSV that matters to you (default: the robot's whole range)",
        ),
    ] = None,
    program: Annotated[
        list[str] | None,
        typer.Option(
            "--program",
            metavar="FORMAT",
            help="with files:DIR, also write a controller program; repeatable",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="send motions to a real robot without asking")
    ] = False,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume", metavar="DIR", help="continue the loop of this folder, as it was set"
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            help="folder for motions, logs and the result",
            callback=require_folder,
        ),
    ] = FOLDER,
    as_json: AsJson = False,
) -> None:
    """Move a robot in rounds until its model is proven.

    Each round is designed, recorded, predicted by the model so far, and learned. The first is slow
    and small. It ends when two rounds in a row are predicted within --until, or says why not.
    """
    from asbuilt.apps.run.drivers import DriverRequest, moves_metal, open_driver
    from asbuilt.apps.run.loop import Loop

    model = load_described_robot(robot)
    settings = _read_settings(model.name, options, on, motion, program, resume, out)
    options = RunOptions(**settings["options"])
    folder = resume or out
    wanted = None if settings["motion"] is None else Path(settings["motion"])
    matters = None if wanted is None else asbuilt.read_motion(wanted, model)
    name, _, argument = str(settings["on"]).partition(":")
    with catch_interrupt() as stopped, show_progress() as report:
        request = DriverRequest(
            model=model,
            argument=argument,
            seed=options.seed,
            programs=tuple(settings["programs"]),
            collision=options.collision,
            stopped=stopped,
        )
        driver = open_driver(name, request)
        loop = Loop(
            model=model,
            driver=driver,
            folder=folder,
            options=options,
            motion=matters,
            confirm=_make_confirm(driver, asks=moves_metal(driver) and not yes),
            stopped=stopped,
            progress=report,
        )
        loop.files.keep_settings(settings)
        _say(as_json, f"{model.name}: {driver.describe()}; motions and logs in {folder}\n")
        _do_rounds(loop, as_json)
        outcome, files = _write(loop)
    _answer(outcome, loop, files, robot, as_json)
    if outcome.ending != "proven":
        raise typer.Exit(1)


def _read_settings(
    robot: str,
    options: RunOptions,
    on: str | None,
    motion: Path | None,
    program: list[str] | None,
    resume: Path | None,
    out: Path,
) -> dict[str, Any]:
    """Return the settings of a loop: those given, or those of the folder that is resumed."""
    from asbuilt.apps.run.folder import RunFolder

    if resume is None:
        if on is None:
            raise UsageError("run needs --on DRIVER, such as --on virtual:lab or --on files:DIR")
        if RunFolder(out).has_rounds():
            raise UsageError(
                f"{out} holds a loop already; continue it with --resume {out}, or name another"
                " folder with --out"
            )
        return {
            "robot": robot,
            "on": on,
            "motion": None if motion is None else str(motion.resolve()),
            "programs": list(program or ()),
            "options": asdict(options),
        }
    kept = RunFolder(resume).read_settings()
    if kept.get("robot") != robot:
        raise UsageError(f"{resume} holds a loop of {kept.get('robot')}, not of {robot}")
    if out != FOLDER:
        raise UsageError("--resume goes on in its own folder; leave out --out")
    # What may change from start to start: how long the loop goes on.
    changed = {
        name: getattr(options, name)
        for name in ("until", "rounds")
        if getattr(options, name) != getattr(RunOptions(), name)
    }
    kept["options"] |= changed
    return kept | ({"on": on} if on else {}) | ({"programs": program} if program else {})


def _make_confirm(driver: Driver, *, asks: bool) -> Callable[[Path, int], bool]:
    """Return what is asked before a motion is sent, or said where a person must act."""

    def confirm(path: Path, number: int) -> bool:
        waits = getattr(driver, "waits_for", None)
        if waits is not None:
            print(f"round {number}: {waits(asbuilt.read_motion(path))}", file=sys.stderr)
        if not asks:
            return True
        if not sys.stdin.isatty():
            raise UsageError(
                "the driver moves a real robot and nobody can be asked; look at the motion in"
                f" {path} (asbuilt view), then give --yes"
            )
        question = f"round {number}: {path} is within every limit. Send it to the robot?"
        return typer.confirm(question, err=True)

    return confirm


def _do_rounds(loop: Loop, as_json: bool) -> None:
    """Print each round when it is done; an interrupt within one gives that one up."""
    from asbuilt.apps.run.text import HEAD, format_json_line, format_round, round_document

    with suppress(KeyboardInterrupt):
        for made in loop:
            if as_json:
                print(format_json_line(round_document(made)), flush=True)
            else:
                _say(False, f"{HEAD}\n" if made.number == 1 else "", format_round(made), "\n")


def _write(loop: Loop) -> tuple[Outcome, dict[str, Path]]:
    """Return how the loop ended, and the files of its study and its picture."""
    from asbuilt.apps.run.text import write_promise_figure

    outcome = loop.outcome
    files = dict[str, Path]()
    if outcome.study is not None:
        files, _ = writers.write_study(loop.folder, outcome.study, command=sys.argv[1:])
        drawn = write_promise_figure(loop.folder / "promise.png", outcome.rounds, loop.options)
        files |= {} if drawn is None else {"promise": drawn}
    return outcome, files


def _answer(
    outcome: Outcome, loop: Loop, files: dict[str, Path], robot: str, as_json: bool
) -> None:
    from asbuilt.apps.run.text import draw_promises, format_json_line, outcome_document
    from asbuilt.tables import wrap_text

    if as_json:
        document = outcome_document(outcome, loop.model.name, loop.options, files)
        print(format_json_line(document), flush=True)
        return
    study = outcome.study
    text = outcome.text
    following = f"asbuilt run {robot} --resume {loop.folder}, which goes on"
    if outcome.ending == "proven":
        following = f"asbuilt export {files['result']} --mjcf robot.xml (or --urdf, --c)"
    elif outcome.ending in ("with care", "unreachable"):
        following = f"asbuilt compare {files['result']}, which says where it differs from CAD"
    parts = [draw_promises(outcome.rounds, loop.options), "", wrap_text(text)]
    if study is not None:
        parts += ["", writers.study_text(study, cure_text=describe_cure).rstrip()]
        parts.append(summarise_files(files, following))
    _say(False, "\n".join(parts), "\n")


def _say(as_json: bool, *parts: str) -> None:
    if not as_json:
        print_text("".join(parts))


@contextmanager
def catch_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed.

    A second Ctrl-C raises `KeyboardInterrupt`. Only the main thread can catch it.
    """
    pressed = threading.Event()

    def note(number: int, frame: FrameType | None) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()
        print("asbuilt: ends after this round; Ctrl-C again ends at once", file=sys.stderr)

    if threading.current_thread() is not threading.main_thread():
        yield pressed.is_set
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)
