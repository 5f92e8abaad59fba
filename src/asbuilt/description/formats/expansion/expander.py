"""Expansion of one xacro file: what a child process runs.

The package xacro expands macros, properties and conditions. Its expressions are Python, from whose
restrictions a generator's frames lead out, so that those of strangers are evaluated on a list of
ours. Whatever that overlooks meets the audit hook, which lets nothing happen but reading.
"""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

from asbuilt.description.formats.expansion.expressions import BUILTINS, MATH, evaluate

MEMORY = 1_000_000_000
"""Bytes that an expansion may take; `'a' * 10**10` asks for any amount."""
SUFFIXES = (".urdf", ".xacro", ".xml", ".yaml", ".yml")
"""Suffixes of files that a description may include or load."""
NEEDED = ("safe_eval", "eval_extension", "_global_symbols", "NameSpace", "process_file")
"""What is replaced or used of xacro; a version without one of them is not used."""
AHEAD = ("xml.dom.expatbuilder", "xml.dom.pulldom", "encodings.utf_16", "encodings.latin_1")
"""Modules that reading needs later, when none can be imported any more."""
HARMLESS = ("builtins.id", "compile", "object.__getattr__", "sys._getframe")
"""Audited events of parsing and copying; no code that is compiled can be run."""


def expand(path: str, largest: int, *, trusted: bool) -> None:
    """Write the URDF of a xacro file on stdout and end this process; with status 2 if it cannot.

    One line on stderr says why. `largest` limits the bytes of a file that is read and of the URDF.
    """
    answer, reason = os.fdopen(os.dup(1), "wb"), os.fdopen(os.dup(2), "wb")
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115 - until the process ends
    status = 0
    try:
        _limit_memory()
        xacro: Any = import_module("xacro")
        if not trusted:
            _restrict(xacro, Path(path).parent, largest)
        content = xacro.process_file(path).toprettyxml(indent="  ").encode()
        if len(content) > largest:
            raise ValueError(f"the URDF has {len(content)} bytes, more than {largest}")
        answer.write(content)
        answer.flush()
    except BaseException as problem:
        said = " ".join(str(problem).split()) or type(problem).__name__
        reason.write(said[:300].encode(errors="replace"))
        reason.flush()
        status = 2
    os._exit(status)


def _restrict(xacro: Any, folder: Path, largest: int) -> None:
    """Give a stranger's file expressions of ours, and files of its own folder, alone."""
    missing = [name for name in NEEDED if not hasattr(xacro, name)]
    if missing:
        raise ImportError(f"this version of xacro has no {missing[0]}; 2.1 has")
    for name in (*AHEAD, "yaml"):
        with contextlib.suppress(ImportError):
            import_module(name)
    math, python, own = (xacro.NameSpace() for _ in range(3))
    math.update(MATH)
    python.update(BUILTINS)
    own.update(load_yaml=xacro.load_yaml, dotify=dict, arg=_argument(xacro))
    names = {**MATH, **BUILTINS, "load_yaml": xacro.load_yaml}
    xacro._global_symbols = names | {"math": math, "python": python, "xacro": own}
    functions = [each for each in (*names.values(), *own.values()) if callable(each)]
    xacro.safe_eval = lambda text, symbols, local=None: evaluate(text, symbols, functions)
    xacro.eval_extension = lambda text: _substituted(xacro, text)
    warnings.simplefilter("ignore")
    sys.addaudithook(lambda event, given: _allow(event, given, folder, largest))


def _argument(xacro: Any) -> Any:
    """Return the function that gives an argument of the file by name."""
    return lambda name: xacro.substitution_args_context["arg"][name]


def _substituted(xacro: Any, text: str) -> Any:
    """Return what `$(arg NAME)` stands for; what asks for more than that is refused."""
    command, *names = text[2:-1].split()
    if command != "arg" or len(names) != 1:
        raise ValueError(f"{text[:80]} is not allowed")
    return _argument(xacro)(names[0])


def _allow(event: str, given: tuple[Any, ...], folder: Path, largest: int) -> None:
    """Raise `PermissionError` unless an audited event is harmless or reads a file of the folder."""
    if event in HARMLESS:
        return
    if event in ("glob.glob", "os.listdir", "os.scandir", "open"):
        place, mode = Path(os.path.realpath(os.fsdecode(given[0]))), given[1:2] or ("r",)
        reads = event != "open" or mode[0] in ("r", "rb", None)
        if reads and place.is_relative_to(folder) and (event != "open" or _is_file(place, largest)):
            return
        raise PermissionError(f"{given[0]} is not a description in the folder of the robot")
    raise PermissionError(f"{event} is not allowed")


def _is_file(place: Path, largest: int) -> bool:
    """Return whether a path may be read: a regular file, of a description, and not too large."""
    if place.suffix.lower() not in SUFFIXES:
        return False
    state = os.stat(place)
    return stat.S_ISREG(state.st_mode) and state.st_size <= largest


def _limit_memory() -> None:
    with contextlib.suppress(ImportError, ValueError, OSError):
        resource: Any = import_module("resource")  # not on Windows
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
