"""Functions run in child processes, each with limits of memory, disk and computing time.

Time is CPU time: on a slow or loaded computer a call takes longer and costs the same. Waiting is
limited only where nothing moves at all, as in front of a pipe that nobody writes to.

A child that starts costs more than most calls take, so one that has answered well answers the next.
It is no prison: it only takes crashes, memory and time upon itself.
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import json
import math
import os
import pickle
import platform
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
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
WAITED_FOR = 0x0010_0000
NOT_YET = 0x102
"""SYNCHRONIZE and WAIT_TIMEOUT of Windows."""
ORPHAN_CHECK = 0.5
"""Seconds between looks at the parent process, where the system does not look."""
ENDING = 0.5
"""Seconds that a child is given to end by itself, as one that has no more requests does."""
OWN_GROUP: Mapping[str, Any] = {"creationflags": 0x200} if os.name == "nt" else {"process_group": 0}
"""How a child starts apart (CREATE_NEW_PROCESS_GROUP of Windows): Ctrl-C is for this process, which
ends its children."""
STILL = 60.0
"""Seconds without any computing after which a child waits in vain; it gets some in every second
on a computer with a hundred others."""
LOOK = 0.5
"""Seconds between looks at a child that is limited."""
SLOWEST = 50.0
"""Multiple of the computing time that a call may wait where the system does not tell it."""


HOST = re.sub(r"[^\w-]", "-", platform.node()) or "local"
"""This machine in the names of temporary files, which several may share."""


def open_scratch() -> tempfile.TemporaryDirectory[str]:
    """Return a folder of temporary files, gone at the end of a `with` statement.

    Its name has machine and process, by which the first of the next process removes the folder of
    one that was killed.
    """
    _remove_scratch_once()
    prefix = f"asbuilt-{HOST}.{os.getpid()}."
    return tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True)


def remove_scratch() -> None:
    """Remove the folders that processes of this machine and user left when they were killed."""
    for path in Path(tempfile.gettempdir()).glob(f"asbuilt-{glob.escape(HOST)}.*.*"):
        process = path.name.split(".")[-2]
        with contextlib.suppress(OSError):
            state = path.lstat()  # a link of another user leads anywhere
            own = state.st_uid == getattr(os, "getuid", lambda: 0)()
            left = process.isdigit() and not is_running(int(process))
            if own and left and stat.S_ISDIR(state.st_mode):
                shutil.rmtree(path, ignore_errors=True)


_remove_scratch_once = cache(remove_scratch)


class ChildEnded(Exception):  # noqa: N818 - what happened, which its caller explains
    """Say that a child ended before it answered, with its exit status; below zero, the signal.

    `stopped` is "still" or "disk" where it was ended because it waited in vain, or wrote too much.
    """

    def __init__(self, status: int, stopped: str = "") -> None:
        super().__init__(f"its process ended with status {status}")
        self.status = status
        self.stopped = stopped


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
            **OWN_GROUP,
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
        disk: int | None = None,
    ) -> list[bytearray]:
        """Return what a pickled function with its arguments returns: a sequence of buffers.

        It may take `memory` [bytes] beyond what is used before, CPU time [s], zero is no limit, and
        `disk` [bytes] for temporary files, which are gone when the call has ended, however it did.
        Raises `ChildEnded` if the child ends before, or its answer has more than `largest` bytes.
        """
        self.calls += 1
        limits = [memory, seconds, os.getcwd(), disk]
        if not seconds:
            return self._ask(request, [*limits, ""], largest)
        with open_scratch() as scratch, Watch(self._process, seconds, scratch, disk) as watch:
            try:
                return self._ask(request, [*limits, scratch], largest)
            except BaseException as problem:
                self.end(kill=True)  # nothing more may be written to the folder
                if isinstance(problem, ChildEnded):
                    raise ChildEnded(problem.status, watch.stopped) from None
                raise

    def _ask(self, request: bytes, limits: Sequence[Any], largest: float) -> list[bytearray]:
        """Send a request with its limits, and return the answer."""
        stdin = cast(BinaryIO, self._process.stdin)
        stdout = cast(BinaryIO, self._process.stdout)
        head = json.dumps([len(request), *limits])
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


class Watch:
    """End a process that computes nothing for long, or fills its folder of temporary files.

    In a `with` statement, in whose thread the process is waited for; this one looks at it from
    another. The process is killed where the statement ends with an error, such as Ctrl-C.

    Parameters
    ----------
    process
        What is watched.
    seconds
        CPU time that it should need [s], for where the system does not tell what it used.
    scratch, disk
        Folder of its temporary files, and the bytes that they may have.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        seconds: float,
        scratch: str = "",
        disk: float | None = None,
    ) -> None:
        self.stopped = ""
        self._process = process
        self._longest = SLOWEST * seconds
        self._disk = math.inf if disk is None else disk
        self._scratch = scratch
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_rest: object) -> None:
        if kind is not None:
            self._process.kill()
        self._done.set()
        self._thread.join()

    def _look(self) -> None:
        began = moved = time.monotonic()
        known = -1.0
        while not self._done.wait(LOOK):
            now = time.monotonic()
            used = read_cpu_time(self._process.pid)
            if used is None:
                still = now - began > self._longest
            else:
                moved = moved if used == known else now
                known = used
                still = now - moved > STILL
            full = sum(_list_sizes(self._scratch)) > self._disk
            if still or full:
                self.stopped = "disk" if full else "still"
                self._process.kill()
                return


def read_cpu_time(process: int) -> float | None:
    """Return the CPU time [s] that a process has used; None if the system does not tell."""
    try:
        # The name in parentheses may hold blanks: user and system time are 11 and 12 behind it.
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def _list_sizes(folder: str) -> Iterator[int]:
    """Yield the sizes [bytes] of the files in a folder, which may vanish; nothing of no folder."""
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                yield os.stat(os.path.join(place, name)).st_size


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
        self._threads = ThreadPoolExecutor(count)
        self._environment = environment
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
        size, memory, seconds, folder, disk, scratch = json.loads(head)
        os.chdir(folder)
        tempfile.tempdir = scratch or None
        function, arguments = pickle.loads(sys.stdin.buffer.read(size))
        _limit(memory, seconds, disk)
        answer = [memoryview(part) for part in function(*arguments)]
        answers.write(json.dumps([part.nbytes for part in answer]).encode() + b"\n")
        for part in answer:
            answers.write(part)
        answers.flush()
        _limit(None, 0.0, None)
    os._exit(0)


def _limit(memory: int | None, seconds: float, disk: int | None) -> None:
    """Limit CPU time, files and memory beyond what is used, where the system can; None lifts it."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    signal.setitimer(signal.ITIMER_PROF, seconds)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        largest = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest if disk is None else disk, largest))
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
    # The parent on Windows may be the launcher of a virtual environment, which `parent` started.
    while is_running(parent) if sys.platform == "win32" else os.getppid() == parent:
        time.sleep(ORPHAN_CHECK)
    os._exit(1)


def is_running(process: int) -> bool:
    """Return whether a process of this machine runs."""
    if sys.platform == "win32":  # where signal 0 of `os.kill` is Ctrl-C
        kernel: Any = ctypes.WinDLL("kernel32")
        kernel.OpenProcess.restype = ctypes.c_void_p
        handle = ctypes.c_void_p(kernel.OpenProcess(WAITED_FOR, False, process))
        try:
            return bool(kernel.WaitForSingleObject(handle, 0) == NOT_YET)
        finally:
            kernel.CloseHandle(handle)
    try:
        os.kill(process, 0)
    except OSError as error:
        return not isinstance(error, ProcessLookupError)
    return True
