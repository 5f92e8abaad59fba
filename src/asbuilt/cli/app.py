"""The command line: commands are imported when they are run or when their help is shown."""

from __future__ import annotations

import contextlib
import ctypes
import difflib
import errno
import inspect
import io
import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from asbuilt.cli.answers import describe_cure, fold_text, open_screen
from asbuilt.cli.arguments.spread import Common, print_version, spread
from asbuilt.cli.commands import ABSENT, COMMANDS, EVERY_COMMAND, GROUPS, SUBCOMMANDS, Entry
from asbuilt.errors import AsbuiltError, UsageError, without_long_words
from asbuilt.findings import Cure
from asbuilt.untrusted import (
    allow_xacro_python,
    describe_problem,
    protect_inputs,
    set_xacro_arguments,
    shorten_path,
)

BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables of linear algebra libraries, whose threads slow small matrices down."""

FULL_DISK = "asbuilt: the output cannot be written: No space left on device; free some space"

WRITE_SHEET = "--write-sheet"
"""Option of `check` that writes what a log needs beside it."""

LONGEST_MESSAGE = 3000
"""Characters of an error, which may quote names from a file."""

INTERRUPTED = 130
"""Exit status after Ctrl-C."""

HELP = {"help_option_names": ["-h", "--help"]}
VERSION = Annotated[
    bool,
    typer.Option(
        "--version", is_eager=True, callback=print_version, help="Show the version and exit."
    ),
]


class Command(TyperCommand):
    """A command whose help groups its options and ends with two examples."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Read the arguments; an option that may stand alone then has the empty value."""
        entry = COMMANDS.get(self.name or "")
        bare = () if entry is None else entry.bare
        given = [
            f"{each}=" if each in bare and following.startswith("-") else each
            for each, following in pairwise([*args, "-"])
        ]
        return super().parse_args(ctx, given)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return `[OPTIONS]` and the names of the arguments."""
        return ["[OPTIONS]", *(str(param.metavar) for param in _list_arguments(self, ctx))]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options under the heading of their group."""
        arguments = _list_arguments(self, ctx)
        sections = {"Arguments": [(str(param.metavar), param.help or "") for param in arguments]}
        for param in self.get_params(ctx):
            record = None if param in arguments else param.get_help_record(ctx)
            if record is not None:
                panel = getattr(param, "rich_help_panel", None) or "Options"
                sections.setdefault(panel, []).append(record)
        general = sections.pop("Options")
        for title, rows in {**sections, "Options": general}.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows, col_max=24)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples, one a line."""
        _write_examples(ctx, formatter)


def _list_arguments(command: Any, ctx: Any) -> list[Any]:
    return [param for param in command.get_params(ctx) if param.param_type_name == "argument"]


class Commands(TyperGroup):
    """All commands by group, or the subcommands of one such as `fleet`, from the static table."""

    @property
    def _sections(self) -> Mapping[str, Mapping[str, Entry]]:
        return {"Commands": SUBCOMMANDS[self.name]} if self.name in SUBCOMMANDS else GROUPS

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of its commands."""
        return [name for entries in self._sections.values() for name in entries]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import a command; raises `UsageError` if there is none of this name."""
        entries = {name: each for group in self._sections.values() for name, each in group.items()}
        if cmd_name in ABSENT and self.name not in SUBCOMMANDS:
            raise UsageError(
                f"the command {cmd_name!r} belongs to the app {ABSENT[cmd_name]}, which this"
                " installation is without",
                cure=Cure("install asbuilt as it is distributed"),
            )
        if cmd_name not in entries:
            near = difflib.get_close_matches(cmd_name, entries, n=1)
            place = "" if ctx is None else ctx.command_path
            guess = f"did you mean {near[0]}?" if near else f"{place} -h lists the commands"
            raise UsageError(f"there is no command {cmd_name!r}", cure=Cure(guess))
        entry = entries[cmd_name]
        if cmd_name in SUBCOMMANDS and self.name not in SUBCOMMANDS:
            return typer.main.get_command(
                _make_group(cmd_name, help=entry.summary, add_completion=False)
            )
        return _import_command(cmd_name, entry)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands of each group with their summaries."""
        for title, entries in self._sections.items():
            with formatter.section(title):
                formatter.write_dl([(name, entry.summary) for name, entry in entries.items()])

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write two examples, or what explains more."""
        if self.name in SUBCOMMANDS:
            _write_examples(ctx, formatter)
        else:
            super().format_epilog(ctx, formatter)


def _write_examples(ctx: Any, formatter: Any) -> None:
    place = ctx.command_path.removeprefix("asbuilt ")
    if place in EVERY_COMMAND:
        with formatter.section("Examples"):
            for arguments in EVERY_COMMAND[place].examples:
                formatter.write(f"  asbuilt {place} {arguments}".rstrip() + "\n")


def _import_command(name: str, entry: Entry) -> Any:
    """Import a command."""
    function = getattr(import_module(f"asbuilt.{entry.module}"), name)

    def run(common: Common, call: Callable[[], None]) -> None:
        with (
            open_screen(common, compiles=entry.compiles),
            allow_xacro_python(common.trust_xacro),
            set_xacro_arguments(common.xacro_arguments),
            protect_inputs(),
        ):
            call()

    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    more = inspect.cleandoc(function.__doc__ or "").partition("\n\n")[2]
    help_text = f"{entry.summary}\n\n{more}".strip()
    alone.command(name, cls=Command, help=help_text, context_settings=HELP)(spread(function, run))
    return typer.main.get_command(alone)


def _make_group(name: str, **described: Any) -> typer.Typer:
    """Return a command that has commands, and shows its help without one."""
    group = typer.Typer(
        name=name, cls=Commands, context_settings=HELP, rich_markup_mode=None, **described
    )

    @group.callback(invoke_without_command=True)
    def begin(context: typer.Context, version: VERSION = False) -> None:
        if context.invoked_subcommand is None:
            print(context.get_help())
            raise typer.Exit(2)

    return group


app = _make_group(
    "asbuilt",
    help=(
        "Identify the dynamic model of a robot arm as built, from its description and recordings"
        " of its motion and torque."
    ),
    epilog="asbuilt COMMAND -h explains a command"
    + ("; asbuilt demo shows a complete run." if "demo" in COMMANDS else "."),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 data or robot do not allow it, 2 wrong usage."""
    for setting in BLAS_THREADS:
        os.environ.setdefault(setting, "1")
    _return_freed_memory()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    sys.exit(_flush_output(_run_for_status([*(sys.argv[1:] if arguments is None else arguments)])))


def _return_freed_memory() -> None:
    """Let the system have large arrays back when they are freed, where the C library is glibc.

    Else it keeps room for the largest so far, in pieces that the next do not fit, and for each
    thread apart. Of smaller ones it keeps some room: given back with every array and asked for
    again with the next, each page of it is a fault, and faults take up to half of a large check.
    """
    largest_kept = 1 << 24  # bytes
    room_kept = 1 << 28  # bytes
    of_arrays = -3  # M_MMAP_THRESHOLD
    of_room = -1  # M_TRIM_THRESHOLD
    of_threads = -8  # M_ARENA_MAX
    with contextlib.suppress(OSError, AttributeError, TypeError):
        library = ctypes.CDLL(None)
        library.mallopt(of_arrays, largest_kept)
        library.mallopt(of_room, room_kept)
        library.mallopt(of_threads, 1)


def _flush_output(status: int) -> int:
    """Write what is buffered; a full disk or a closed pipe is an error that is reported once."""
    if sys.stdout is None or sys.stderr is None:
        return status
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError as problem:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            if stream is sys.stdout and not isinstance(problem, BrokenPipeError):
                _say(FULL_DISK)
            status = status or 1
    return status


def _run_for_status(given: list[str]) -> int:
    """Run the command line; report every failure and return the exit status."""
    try:
        os.getcwd()  # files are named from here, and nothing works where it was deleted
    except OSError:
        hint = "change to another one"
        message = "the current folder does not exist any more"
        return _fail(given, "FileNotFoundError", message, hint, {}, 1)
    try:
        status = typer.main.get_command(app).main(
            args=given, prog_name="asbuilt", standalone_mode=False
        )
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (KeyboardInterrupt, EOFError, typer.Abort):
        status = INTERRUPTED
    except Exception as problem:
        if isinstance(problem, OSError) and problem.errno == errno.ENOSPC:
            _say(FULL_DISK)
            return 1
        return _fail(given, *_describe_failure(problem))
    if status == INTERRUPTED:
        message = "interrupted; no file is half-written"
        return _fail(given, "KeyboardInterrupt", message, "", {}, status)
    return status if isinstance(status, int) else 0


def _describe_failure(problem: Exception) -> tuple[str, str, str, dict[str, Any], int]:
    """Return kind, message, hint, values for programs, and exit status of an error."""
    kind = type(problem).__name__
    text = str(problem)
    if isinstance(problem, AsbuiltError):
        status = 2 if isinstance(problem, UsageError) else 1
        hint = describe_cure(problem.cure)
        if isinstance(problem.cure, Cure) and problem.cure.sheet and WRITE_SHEET not in hint:
            hint = (
                f"{hint.rstrip()}\n\nOr let asbuilt check ROBOT LOG {WRITE_SHEET} write the sheet."
            )
        return kind, problem.message, hint, problem.fields, status
    if isinstance(problem, typer.TyperException):
        place = getattr(getattr(problem, "ctx", None), "command_path", "asbuilt")
        message = " ".join(problem.format_message().split()).rstrip(".")
        entry = EVERY_COMMAND.get(place.removeprefix("asbuilt "))
        hint = ""
        if entry is not None and "unexpected extra argument" in message:
            hint = entry.surplus
        return "UsageError", message, hint or f"{place} -h lists the options", {}, 2
    if isinstance(problem, MemoryError):
        detail = f": {text}" if text else ""
        message = f"there is not enough memory{detail}; {_describe_memory()}"
        hint = "use fewer samples: decimate, or cut the recording"
        return "MemoryError", message, hint, {}, 1  # NumPy has a kind of its own
    if isinstance(problem, OSError) and problem.filename is not None:
        message = f"{shorten_path(str(problem.filename))}: {describe_problem(problem)}"
        return kind, message, "", {}, 1
    if os.environ.get("ASBUILT_TRACEBACK"):
        traceback.print_exception(problem)
    message = f"unexpected {kind}: {text}"
    return kind, message, "please report it with the output of ASBUILT_TRACEBACK=1", {}, 1


def _describe_memory() -> str:
    """Return the memory of this machine, or the limit that this process has of it."""
    most = math.inf
    with contextlib.suppress(ImportError, ValueError, OSError, AttributeError):
        most = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        import resource

        for limit in (resource.RLIMIT_AS, resource.RLIMIT_DATA):
            soft = resource.getrlimit(limit)[0]
            most = min(most, soft if soft != resource.RLIM_INFINITY else math.inf)
    return f"this process may have {most / 1e9:.3g} GB"


def _fail(
    given: Sequence[str], kind: str, message: str, hint: str, values: dict[str, Any], status: int
) -> int:
    """Report an error: one document on stdout with --json, else a message on stderr."""
    message = without_long_words(message)
    if len(message) > LONGEST_MESSAGE:
        message = message[:LONGEST_MESSAGE] + " ..."
    if "--json" in given:
        error = {"kind": kind, "message": message, "hint": hint or None, **values}
        with contextlib.suppress(BrokenPipeError):  # nobody reads it, which the end notices too
            print(json.dumps({"error": error}, indent=2, default=str, allow_nan=False))
    else:
        _say(fold_text(f"asbuilt: {message}" + (f"; {hint}" if hint else "")))
        if other := _find_other_sheet(given, kind, values):
            _say(fold_text(f"Or read it by the sheet of a log beside it: --sheet {other}"))
    return status


def _find_other_sheet(given: Sequence[str], kind: str, values: Mapping[str, Any]) -> str:
    """Return the sheet of another log of the folder that may read one which cannot be read."""
    log = values.get("file")
    if kind != "RecordingError" or not isinstance(log, str) or "--sheet" in given:
        return ""
    from asbuilt.experiment.logs.sheet import find_sheet_of_another

    # A name that cannot be looked for has no sheet either.
    with contextlib.suppress(OSError):
        return str(find_sheet_of_another(Path(log)) or "")
    return ""


def _say(text: str) -> None:
    """Print on stderr, which may be closed."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)
