"""Child processes of this program: nothing that lies in the current folder is imported or run.

A robot or a log often lies in a folder of its own, which a stranger filled. Python looks for
modules there first, so that a file `resource.py` next to a robot would be run.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

KEPT = ("DYLD_LIBRARY_PATH", "LD_LIBRARY_PATH", "SYSTEMROOT", "TEMP", "TMP", "TMPDIR")
"""Variables of the environment that a child needs to load libraries and to keep temporary files."""


def build_isolated_command(program: str) -> list[str]:
    """Return the command that runs a Python program with no more than the modules of this one.

    Neither the current folder, nor the environment, nor files of the user are consulted.
    """
    begin = f"import sys; sys.path[:] = {_list_module_folders()!r}; "
    return [sys.executable, "-I", "-S", "-c", begin + program]


def build_trusted_command(program: str) -> list[str]:
    """Return the command that runs a Python program with all modules of this one."""
    return [sys.executable, "-I", "-c", f"import sys; sys.path[:] = {sys.path!r}; {program}"]


def build_isolated_environment(more: Mapping[str, str]) -> dict[str, str]:
    """Return `more` and the few variables of this environment that a child needs."""
    return {name: os.environ[name] for name in KEPT if name in os.environ} | dict(more)


def leave_current_folder() -> None:
    """Import nothing further from the current folder, which `python -m` searches first."""
    sys.path[:] = _list_module_folders()


def _list_module_folders() -> list[str]:
    """Return the folders of modules without the current one, unless this package lies there."""
    try:
        here = os.path.realpath(os.curdir)
    except OSError:  # the current folder was deleted, and has no modules
        here = ""
    home = str(Path(__file__).resolve().parents[1])
    return [
        each
        for each in sys.path
        if os.path.isabs(each) and (os.path.realpath(each) != here or here == home)
    ]
