"""Process that runs the commands of a page one after another, and that can be ended at any time.

It is the command line: `main` gets the arguments, what it prints on stdout is the answer, and its
progress is reported line by line. Files of strangers meet the limits that they meet there, and a
crash ends this process alone.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, cast

from asbuilt.isolation import build_isolated_command

PROGRAM = "from asbuilt.apps.page.worker import serve; serve()"
LONGEST_TEXT = 2000
"""Characters of what a command that failed printed."""
Progress = Callable[[str, float], None]


class Worker:
    """Run commands in another process, which is started before it is needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._start()

    def run(self, arguments: Sequence[str], progress: Progress) -> dict[str, Any]:
        """Return the document that a command prints with `--json`, or one with `error`.

        A process that ends before it has answered was cancelled, or has crashed.
        """
        process = self._start()
        stdin = cast(Any, process.stdin)
        stdout = cast(Any, process.stdout)
        with contextlib.suppress(OSError):
            stdin.write(json.dumps([*arguments, "--json"]).encode() + b"\n")
            stdin.flush()
        for line in stdout:
            message = json.loads(line)
            if "answer" in message:
                return cast(dict[str, Any], message["answer"])
            progress(*message["progress"])
        return _make_error("Ended", f"the command ended with status {process.wait()}")

    def cancel(self) -> None:
        """End the running command; no file is half-written. The next process starts at once."""
        self.close()
        self._start()

    def close(self) -> None:
        """End the process."""
        with self._lock:
            process = self._process
            self._process = None
        if process is not None:
            process.kill()
            process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._process is None or self._process.poll() is not None:
                self._process = subprocess.Popen(
                    build_isolated_command(PROGRAM),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    env=None,
                )
            return self._process


def serve() -> None:
    """Run a command for each line of stdin until there are no more; what the process runs."""
    from asbuilt.cli import main

    importlib.import_module("asbuilt.workflow.study")  # before the first command that needs it
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    def tell(**message: Any) -> None:
        answers.write(json.dumps(message).encode() + b"\n")
        answers.flush()

    for line in sys.stdin.buffer:
        tell(answer=_answer(main, json.loads(line), lambda *done: tell(progress=done)))


def _answer(main: Callable[..., None], arguments: list[str], progress: Progress) -> dict[str, Any]:
    from asbuilt.cli import tell_progress

    printed = io.StringIO()
    status = 0
    with contextlib.redirect_stdout(printed), tell_progress(progress):
        try:
            main(arguments)
        except SystemExit as end:
            status = int(end.code or 0)
    try:
        return cast(dict[str, Any], json.loads(printed.getvalue()))
    except ValueError:
        text = printed.getvalue()[:LONGEST_TEXT]
        return _make_error("Ended", f"the command ended with status {status}. {text}")


def _make_error(kind: str, message: str) -> dict[str, Any]:
    return {"error": {"kind": kind, "message": message, "hint": None}}
