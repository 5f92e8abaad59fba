"""The entry of the command line, before its modules are imported."""

import atexit
import contextlib
import gc
import os
import signal
import sys

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of shells after Ctrl-C."""
YOUNG_OBJECTS = 500_000
"""Containers, made and not yet freed, after which the collector looks for cycles.

Python's 700 make it walk 400 times over modules that stay to the end: a twentieth of a short run,
which makes some 300 000 containers, modules included. Arrays go with the last name that refers to
them, whatever this is.
"""


def run() -> None:
    """Run the command line; Ctrl-C while its modules are imported ends it without a traceback."""
    try:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    # To look for plugins, pydantic reads the metadata of all that is installed.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")
    gc.set_threshold(YOUNG_OBJECTS, *gc.get_threshold()[1:])
    ended = list[int]()
    # What is registered first comes last: files and workers of others are done with by then.
    atexit.register(_leave, ended)
    _open_closed_streams()
    from asbuilt.isolation import leave_current_folder

    leave_current_folder()
    from asbuilt.cli.app import main

    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        main()
    except SystemExit as end:
        if isinstance(end.code, int):
            ended.append(end.code)
        raise


def _leave(ended: list[int]) -> None:
    """Leave the process, whose memory goes with it: Python would free module after module.

    That takes a tenth of a short run, a fiftieth without a search for cycles before it. `ended` has
    the exit status if the command line came to its end; else Python has to say what happened.
    """
    if ended:
        # What cannot be written is for Python to say.
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(ended[0])
    gc.freeze()


def _open_closed_streams() -> None:
    """Let a closed stdin, stdout or stderr (`>&-`) lead nowhere.

    Else the next file that is opened has its number, and is written to in its place.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if name == "stdin" else "w", encoding="utf-8"))
