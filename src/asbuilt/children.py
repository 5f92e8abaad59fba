"""Functions run in child processes, each with limits of memory and time.

A child that starts costs more than most calls take, so one that has answered well answers the next.
It is no prison: it only takes crashes, memory and time upon itself.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, cast

from asbuilt.isolation import (
    build_isolated_command,
    build_isolated_environment,
    build_trusted_command,
)

PROGRAM = "from asbuilt.children import serve; serve({parent})"
DIES_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""
ORPHAN_CHECK = 0.5
"""Seconds between looks at the parent process, where the system does not look."""
ENDING = 0.5
"""Seconds that a child is given to end by itself, as one that has no more requests does."""


class ChildEnded(Exception):  # noqa: N818 - what happened, which its caller explains
    """Say that a child ended before it answered, with its exit status; below zero, the signal."""

    def __init__(self, status: int) -> None:
        super().__init__(f"its process ended with status {status}")
        self.status = status


class Child:
    """A process that runs one function after another.

    Parameters
    ----------
    environment
        Further variables of its environment.
    trusted
        Whether it gets the environment and all modules of this process. Otherwise neither the
        current folder, nor the environment, nor files of the user are consulted.
    """

    def __init__(self, environment: Mapping[str, str], *, trusted: bool = False) -> None:
        build_command = build_trusted_command if trusted else build_isolated_command
        self._process = subprocess.Popen(
            build_command(PROGRAM.format(parent=os.getpid())),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **environment}
            if trusted
            else build_isolated_environment(environment),
            process_group=0,  # Ctrl-C is for this process, which ends its children
        )
        self._made_by = (os.getpid(), tuple(sys.path))
        self.calls = 0

    @property
    def is_usable(self) -> bool:
        """Whether it still runs, and was started by this process with the same modules."""
        made_here = self._made_by == (os.getpid(), tuple(sys.path))
        return made_here and self._process.poll() is None

    def call(
        self,
        request: bytes,
        *,
        memory: int | None = None,
        seconds: float = 0.0,
        largest: float = math.inf,
    ) -> list[bytearray]:
        """Return what a pickled function with its arguments returns: a sequence of buffers.

        It may take `memory` [bytes] beyond what is used before, and a time [s]; zero is no limit.
        Raises `ChildEnded` if the child ends before, or its answer has more than `largest` bytes.
        """
        self.calls += 1
        stdin, stdout = cast(BinaryIO, self._process.stdin), cast(BinaryIO, self._process.stdout)
        head = json.dumps([len(request), memory, seconds, os.getcwd()])
        with contextlib.suppress(BrokenPipeError):
            stdin.write(head.encode() + b"\n" + request)
            stdin.flush()
        line = stdout.readline()
        sizes: list[int] = json.loads(line) if line.endswith(b"\n") else []
        if not sizes or sum(sizes) > largest:
            raise ChildEnded(self.end())
        answer = [bytearray(size) for size in sizes]
        for part in answer:
            if stdout.readinto(part) < len(part):  # type: ignore[attr-defined]
                raise ChildEnded(self.end())
        return answer

    def end(self, *, kill: bool = False) -> int:
        """End the process if it runs, and return its exit status."""
        if self._made_by[0] != os.getpid():
            return 0
        if kill:
            self._process.kill()
            return self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                cast(BinaryIO, stream).close()
        try:
            return self._process.wait(ENDING)
        except subprocess.TimeoutExpired:
            return self.end(kill=True)


class ChildPool:
    """Run functions in trusted children; functions, arguments and results must be picklable.

    Parameters
    ----------
    count
        Number of children, each of which starts when it is needed.
    environment
        Further variables of their environment.
    """

    def __init__(self, count: int, environment: Mapping[str, str]) -> None:
        self._threads, self._environment = ThreadPoolExecutor(count), environment
        self._children: dict[int, Child] = {}
        self._closed = False

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        """Run a function on arguments in a free child; `ChildEnded` if that dies."""
        return self._threads.submit(self._run, function, arguments)

    def _run(self, function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
        # Cloudpickle has lambdas and functions of the main module, which pickle has not.
        call = import_module("cloudpickle").dumps((function, arguments))
        (answer,) = self._find_child().call(pickle.dumps((_run_pickled_call, (call,))))
        result, problem = pickle.loads(answer)
        if problem is not None:
            raise problem
        return result

    def _find_child(self) -> Child:
        """Return the child of this thread, which starts when it is needed."""
        thread = threading.get_ident()
        child = self._children.get(thread)
        if child is None or not child.is_usable:
            child = self._children[thread] = Child(self._environment, trusted=True)
        if self._closed:  # this thread was starting it while the others were killed
            child.end(kill=True)
        return child

    def close(self) -> None:
        """Kill the children; what they were at ends with `ChildEnded`."""
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for child in list(self._children.values()):
            child.end(kill=True)
        self._threads.shutdown()


def _run_pickled_call(call: bytes) -> list[bytes]:
    """Return the pickled result of a pickled call and None, or None and what it raised."""
    try:
        function, arguments = pickle.loads(call)
        return [import_module("cloudpickle").dumps((function(*arguments), None))]
    except Exception as problem:
        return [import_module("cloudpickle").dumps((None, problem))]


def serve(parent: int) -> None:
    """Answer requests from stdin on stdout until there are no more; what a child runs."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    _end_with(parent)
    while head := sys.stdin.buffer.readline():
        size, memory, seconds, folder = json.loads(head)
        os.chdir(folder)
        function, arguments = pickle.loads(sys.stdin.buffer.read(size))
        _limit(memory, seconds)
        answer = [memoryview(part) for part in function(*arguments)]
        answers.write(json.dumps([part.nbytes for part in answer]).encode() + b"\n")
        for part in answer:
            answers.write(part)
        answers.flush()
        _limit(None, 0.0)
    os._exit(0)


def _limit(memory: int | None, seconds: float) -> None:
    """Limit time, and memory beyond what is used already, where the system can; None lifts it."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    signal.setitimer(signal.ITIMER_REAL, seconds)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        most = allowed = resource.getrlimit(resource.RLIMIT_DATA)[1]
        if memory is not None:
            pages = int(Path("/proc/self/statm").read_text().split()[5])
            allowed = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_DATA, (allowed, most))


def _end_with(parent: int) -> None:
    """Have this process end when its parent dies, which may have no chance to say so."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DIES_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(ORPHAN_CHECK)
    os._exit(1)
