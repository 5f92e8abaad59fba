"""The command `asbuilt run`, and what it says of a loop on screen and as JSON."""

from __future__ import annotations

import json
import math
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import matplotlib.pyplot as plt
import typer
from matplotlib.ticker import NullFormatter

import asbuilt
from asbuilt import UsageError, writers
from asbuilt.apps.run.drivers import Driver, DriverRequest, moves_metal, open_driver
from asbuilt.apps.run.folder import RunFolder, RunSettings
from asbuilt.apps.run.loop import Loop, Outcome
from asbuilt.apps.run.options import RunOptions
from asbuilt.apps.run.rounds import Round
from asbuilt.cli import (
    AsJson,
    Robot,
    describe_cure,
    name_option,
    out_folder,
    print_text,
    show_progress,
    summarise_files,
)
from asbuilt.codec import make_plain
from asbuilt.tables import format_share, wrap_text

FOLDER = Path("asbuilt-run")
GOES_ON = ("until", "rounds")
"""Options that may change from start to start: how long the loop goes on."""


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
    out: Annotated[Path, out_folder("folder for motions, logs and the result")] = FOLDER,
    as_json: AsJson = False,
) -> None:
    """Move a robot in rounds until its model is proven.

    Each round is designed, recorded, predicted by the model so far, and learned. The first is slow
    and small. It ends when two rounds in a row are predicted within --until, or says why not.
    """
    model = asbuilt.load_robot(robot)
    settings = _read_settings(model.name, options, on, motion, program, resume, out)
    options = settings.options
    folder = resume or out
    matters = None if settings.motion is None else asbuilt.read_motion(settings.motion, model)
    name, _, argument = settings.on.partition(":")
    with catch_interrupt() as stopped, show_progress() as report:
        request = DriverRequest(
            model=model,
            argument=argument,
            seed=options.seed,
            programs=settings.programs,
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
) -> RunSettings:
    """Return the settings of a loop: those given, or those of the folder that is resumed."""
    if resume is None:
        if on is None:
            raise UsageError("run needs --on DRIVER, such as --on virtual:lab or --on files:DIR")
        if RunFolder(out).has_rounds():
            raise UsageError(
                f"{out} holds a loop already; continue it with --resume {out}, or name another"
                " folder with --out"
            )
        return RunSettings(
            robot=robot,
            on=on,
            motion=None if motion is None else str(motion.resolve()),
            programs=tuple(program or ()),
            options=options,
        )
    kept = RunFolder(resume).read_settings()
    if kept.robot != robot:
        raise UsageError(f"{resume} holds a loop of {kept.robot!r}, not of {robot}")
    if out != FOLDER:
        raise UsageError("--resume goes on in its own folder; leave out --out")
    changed = {
        field.name: getattr(options, field.name)
        for field in fields(RunOptions)
        if getattr(options, field.name) != field.default
    }
    asked = replace(kept.options, **changed)
    fixed = [name for name in changed if getattr(asked, name) != getattr(kept.options, name)]
    if motion is not None and str(motion.resolve()) != kept.motion:
        fixed.append("motion")
    for name in fixed:
        if name not in GOES_ON:
            raise UsageError(
                f"{name_option(name)} is another one than this loop was started with; leave it"
                " out, or start a loop in another folder"
            )
    return replace(
        kept,
        on=on or kept.on,
        programs=tuple(program or kept.programs),
        options=asked,
    )


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
    with suppress(KeyboardInterrupt):
        for made in loop:
            if as_json:
                print(format_json_line(round_document(made)), flush=True)
            else:
                _say(False, f"{HEAD}\n" if made.number == 1 else "", format_round(made), "\n")


def _write(loop: Loop) -> tuple[Outcome, dict[str, Path]]:
    """Return how the loop ended, and the files of its study and its picture."""
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


VERDICTS = {"yes": "USE", "with care": "WITH CARE", "no": "NO USE", "cad": "(CAD)"}
HEAD = f"{'round':>5}  {'seconds':>7}  {'promised':>8}  {'found':>7}  {'verdict':<9}  learned"
LEARNED = HEAD.index("learned")
"""Column at which what a round taught begins."""
WIDEST = 80
PICTURE = 48
"""Columns of the picture, which has a label of 9 before it."""
MARGIN = 1.3
"""Factor by which the axis of the picture goes beyond its values."""


def format_round(made: Round) -> str:
    """Return the line of a round, folded in its last column."""
    promised = "-" if made.promised is None else format_share(made.promised)
    left = (
        f"{made.number:>5}  {made.seconds:>7.4g}  {promised:>8}  {_share(made.found):>7}"
        f"  {VERDICTS[made.verdict]:<9}  "
    )
    width = max(WIDEST, min(shutil.get_terminal_size().columns, 100)) - LEARNED
    lines = textwrap.wrap("; ".join(made.learned) or "nothing new", width) or [""]
    return left + f"\n{' ' * LEARNED}".join(lines)


def _share(value: float) -> str:
    return format_share(value) if math.isfinite(value) else "-"


def _list_tested(rounds: Sequence[Round]) -> list[Round]:
    """Return the rounds of which a model promised an error, and one was found."""
    return [row for row in rounds if row.promised is not None and math.isfinite(row.found)]


def draw_promises(rounds: Sequence[Round], options: RunOptions) -> str:
    """Return a picture in text: promised (p) and found (f) error by round, `|` the wanted one."""
    until = options.until / 100.0
    rows = [(row.number, row.promised, row.found) for row in _list_tested(rounds)]
    if not rows:
        return ""
    values = [until, *(value for row in rows for value in row[1:] if value)]
    low = math.log(min(values) / MARGIN)
    high = math.log(max(values) * MARGIN)

    def place(value: float) -> int:
        return round((math.log(max(value, min(values))) - low) / (high - low) * (PICTURE - 1))

    lines = ["", "promised (p) and found (f) error, * where they agree, | wanted"]
    for number, promised, found in rows:
        cells = ["."] * PICTURE
        cells[place(until)] = "|"
        p = place(promised or 0.0)
        f = place(found)
        cells[p] = "p"
        cells[f] = "f"
        if p == f:
            cells[p] = "*"
        lines.append(f"round {number:<3}{''.join(cells)}")
    left = format_share(math.exp(low))
    right = format_share(math.exp(high))
    lines.append(f"{'':9}{left}{right:>{PICTURE - len(left)}}  (logarithmic)")
    return "\n".join(lines)


def write_promise_figure(path: Path, rounds: Sequence[Round], options: RunOptions) -> Path | None:
    """Write promised against found error of each round as PNG; None without a tested round."""
    rows = _list_tested(rounds)
    if not rows:
        return None
    numbers = [row.number for row in rows]
    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    axes.plot(numbers, [100 * (row.promised or 0.0) for row in rows], "o--", label="promised")
    axes.plot(numbers, [100 * row.found for row in rows], "s-", label="found")
    axes.axhline(options.until, color="0.5", lw=1.0, label="wanted")
    axes.set_yscale("log")
    # Numbers as the table has them: 0.2, not a power of ten.
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(numbers)
    what = "simulated motion" if options.purpose == "simulator" else "torque"
    axes.set_xlabel("round")
    axes.set_ylabel(f"error of the {what} [%]")
    axes.set_title("Promised before recording, found before learning")
    axes.legend()
    axes.grid(alpha=0.3)
    saved = writers.save_figure(figure, path)
    plt.close(figure)
    return saved


def round_document(made: Round) -> dict[str, Any]:
    """Return the JSON line of a round; errors are shares, those of joints N m or N."""
    return {
        "round": made.number,
        "motion": str(made.motion),
        "seconds": made.seconds,
        "promised": made.promised,
        "found": made.found,
        "verdict": made.verdict,
        "weakest": made.list_weakest(),
        "learned": list(made.learned),
        "goal": made.goal_error,
        "files": {"motion": str(made.motion), "recording": str(made.log)},
    }


def outcome_document(
    outcome: Outcome, robot: str, options: RunOptions, files: Mapping[str, Path]
) -> dict[str, Any]:
    """Return the last JSON line."""
    verdict = None if outcome.study is None else make_plain(outcome.study.verdict)
    return {
        "robot": robot,
        "purpose": options.purpose,
        "until": options.until / 100.0,
        "ending": outcome.ending,
        "text": outcome.text,
        "rounds": len(outcome.rounds),
        "seconds": outcome.seconds,
        "promised": outcome.rounds[-1].goal_error if outcome.rounds else None,
        "verdict": verdict,
        "files": {kind: str(path) for kind, path in files.items()},
    }


def format_json_line(document: Mapping[str, Any]) -> str:
    """Return a document as one line."""
    return json.dumps(make_plain(document), ensure_ascii=False, allow_nan=False)
