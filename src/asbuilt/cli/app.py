"""The command line: each command reads, makes one call and writes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import typer

from asbuilt.cli.identify import compare, identify, payload, validate
from asbuilt.cli.motion import excite, program
from asbuilt.cli.options import with_options_spread
from asbuilt.cli.recording import channels, check, gains, simulate
from asbuilt.cli.robot import base, drives, export, robots, show, view
from asbuilt.cli.story import demo, reproduce
from asbuilt.errors import AsbuiltError, UsageError

app = typer.Typer(
    name="asbuilt",
    help=(
        "The dynamic model of a robot arm as built, from its description and a recording of its"
        " motion and torque."
    ),
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What linear algebra libraries read when they are loaded, which commands do.

Their threads only get in each other's way on small matrices.
"""

INTERRUPTED = 130
"""Exit status after Ctrl-C, with which typer ends a command, too."""

for command in (
    robots,
    drives,
    show,
    base,
    check,
    identify,
    validate,
    compare,
    payload,
    gains,
    channels,
    excite,
    program,
    simulate,
    view,
    export,
    reproduce,
    demo,
):
    app.command()(with_options_spread(command))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every failure is one message on stderr and an exit status of 1 (data,
    robot) or 2 (usage).
    """
    for setting in BLAS_THREADS:
        os.environ.setdefault(setting, "1")
    try:
        app(args=list(arguments) if arguments is not None else None, prog_name="asbuilt")
    except UsageError as problem:
        _fail(str(problem), 2)
    except AsbuiltError as problem:
        _fail(str(problem), 1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (KeyboardInterrupt, EOFError):
        _fail("interrupted; no file was left half-written", INTERRUPTED)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            _fail("interrupted; no file was left half-written", INTERRUPTED)
        raise
    except Exception as problem:
        if os.environ.get("ASBUILT_TRACEBACK"):
            raise
        _fail(
            f"this should not have happened ({type(problem).__name__}: {problem});"
            " ASBUILT_TRACEBACK=1 shows where, please report it",
            1,
        )


def _fail(message: str, status: int) -> None:
    print(f"asbuilt: {message}", file=sys.stderr)
    sys.exit(status)


if __name__ == "__main__":
    main()
