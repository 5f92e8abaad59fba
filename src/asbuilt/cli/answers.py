"""How the commands answer: one document or text on stdout; progress and errors on stderr."""

from __future__ import annotations

import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asbuilt import writers
from asbuilt.cli.arguments.spread import name_option
from asbuilt.cli.commands import EVERY_COMMAND
from asbuilt.findings import Cure
from asbuilt.untrusted import hold_value

if TYPE_CHECKING:
    from asbuilt.cli.arguments.spread import Common
    from asbuilt.compilation import Kernel

COMPILING = "compiling what this command needs: once per installation, a few seconds"
COMPILING_EACH_TIME = (
    "compiling what this command needs: in every run, because machine code cannot be stored;"
    " set NUMBA_CACHE_DIR to a folder you may write to"
)


class Screen:
    """Show progress on stderr: a bar on a terminal, lines with `--verbose`, else nothing."""

    def __init__(self, *, quiet: bool = False, verbose: bool = False) -> None:
        self.quiet = quiet
        self.verbose = verbose
        self._terminal = sys.stderr.isatty()
        self._started = time.perf_counter()
        self._bar: Any = None
        self._tasks: dict[str, Any] = {}
        self._announced = False

    def report(self, what: str, fraction: float) -> None:
        """Show that `what` is done to a fraction; zero shows that it is under way."""
        stage = what.split(":", maxsplit=1)[0]
        first = stage not in self._tasks
        _listener.get()(what, fraction)
        if self.verbose and first:
            self._print_line(f"{time.perf_counter() - self._started:7.1f} s  {stage}")
        if self.quiet or not self._terminal:
            self._tasks.setdefault(stage, None)
            return
        bar = self._open_bar()
        if first:
            for task in self._tasks.values():
                bar.update(task, total=1.0, completed=1.0)
            self._tasks[stage] = bar.add_task(what, total=None)
        bar.update(
            self._tasks[stage],
            description=what,
            completed=fraction,
            total=1.0 if fraction > 0.0 else None,
        )

    def announce_compilation(self, kernel: Kernel) -> None:
        """Say that machine code is being made and, where it can be kept, use all cores."""
        from asbuilt.compilation import compile_kernels

        message = COMPILING if kernel.is_kept else COMPILING_EACH_TIME
        stage = message.replace(":", ",")
        _listener.get()(stage, 0.0)
        if self._terminal:
            self.report(stage, 0.0)
        elif not self.quiet:
            if not self._announced:
                self._print_line(f"asbuilt: {message}")
            self._announced = True
        if kernel.is_kept:
            compile_kernels(kernel, partial(self.report, stage) if self._terminal else _ignore)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
        self._bar = None
        self._tasks = {}

    def _open_bar(self) -> Any:
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
        return self._bar

    def _print_line(self, text: str) -> None:
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        else:
            print(text, file=sys.stderr, flush=True)


def _ignore(fraction: float) -> None:
    """Show nothing."""


_screen: ContextVar[Screen | None] = ContextVar("screen of the running command", default=None)
_listener: ContextVar[Callable[[str, float], None]] = ContextVar(
    "listener to progress in addition to the screen", default=lambda what, fraction: None
)


def tell_progress(listener: Callable[[str, float], None]) -> AbstractContextManager[None]:
    """Report the progress of commands to `listener(what, fraction)` as to the screen."""
    return hold_value(_listener, listener)


@contextmanager
def open_screen(common: Common, *, compiles: bool) -> Iterator[None]:
    """Open the screen of a command, which also announces compilation."""
    screen = Screen(quiet=common.quiet, verbose=common.verbose)
    with ExitStack() as stack:
        stack.callback(screen.close)
        stack.enter_context(hold_value(_screen, screen))
        if compiles:
            from asbuilt.compilation import announce_kernels

            stack.enter_context(announce_kernels(screen.announce_compilation))
        yield


@contextmanager
def show_progress() -> Iterator[Callable[[str, float], None]]:
    """Yield `report(what, fraction)`, which draws on the screen of the command."""
    screen = _screen.get() or Screen(quiet=True)
    try:
        yield screen.report
    finally:
        screen.close()


def answer(as_json: bool, document: Callable[[], dict[str, Any]], text: Callable[[], str]) -> None:
    """Print the document, or the text unless the command is quiet, on stdout."""
    screen = _screen.get() or Screen()
    screen.close()
    if as_json:
        from asbuilt.codec import format_json

        sys.stdout.write(format_json(document()))
    elif not screen.quiet:
        sys.stdout.write(text().strip("\n") + "\n")
    sys.stdout.flush()


def print_text(text: str) -> None:
    """Print a part of a text on stdout at once, unless the command is quiet."""
    screen = _screen.get() or Screen()
    screen.close()
    if not screen.quiet:
        sys.stdout.write(text)
        sys.stdout.flush()


def serve_page(url: str, serve: Callable[[], None], *, browser: bool) -> None:
    """Serve a page until Ctrl-C, and open it in the browser if that is wanted."""
    if browser:
        import webbrowser

        webbrowser.open(url)
    with suppress(KeyboardInterrupt):
        serve()


def describe_cure(cure: Cure | str | None) -> str:
    """Return what to do, with the options and the command that do it; empty if there is no cure.

    >>> describe_cure(Cure("negate the torques", {"flip_torque": True}))
    'negate the torques (--flip-torque)'
    >>> describe_cure(Cure("find the gains from a known payload", call="find_gains"))
    'find the gains from a known payload (asbuilt gains)'
    """
    if not isinstance(cure, Cure):
        return cure or ""
    spelled = [_format_option(name, value) for name, value in cure.settings.items()]
    spelled += [
        f"asbuilt {name}" for name, entry in EVERY_COMMAND.items() if cure.call == entry.call != ""
    ]
    return f"{cure.text} ({', '.join(spelled)})" if spelled else cure.text


def _format_option(name: str, value: Any) -> str:
    option = name_option(name)
    if isinstance(value, bool):
        return option
    shown = ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
    return f"{option} {shown}"


def fold_text(text: str) -> str:
    """Return a message folded to the width of the terminal; as it is if stderr is none."""
    if not sys.stderr.isatty():
        return text
    return textwrap.fill(
        text, shutil.get_terminal_size().columns, break_long_words=False, break_on_hyphens=False
    )


def list_files(files: Mapping[str, Path], notes: Mapping[str, Sequence[str]] | None = None) -> str:
    """Return the lines that name the files written and their notes; empty if there are none."""
    if not files:
        return ""

    width = max(11, *(len(kind) for kind in files))
    return "\n".join(["", "", "written:", *writers.file_lines(files, notes or {}, width)])


def summarise_files(files: Mapping[str, Path], following: str) -> str:
    """Return lines that name the folder of the files written, and the command that follows."""
    from asbuilt.tables import wrap_text

    lines = [wrap_text(following, "Next: ")]
    if files:
        names = ", ".join(path.name for path in files.values())
        lines.insert(0, wrap_text(f"{next(iter(files.values())).parent}: {names}", "Written to "))
    return "\n".join(["", *lines])
