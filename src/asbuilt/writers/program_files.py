"""Programs for controllers as files in a folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from asbuilt.excitation.programs.request import ProgramFile
from asbuilt.writers.files import atomic_write


def write_program(folder: str | os.PathLike[str], files: Sequence[ProgramFile]) -> dict[str, Path]:
    """Write the files of a program, each whole or not at all, and return them by role; scripts become executable."""
    written = {}
    for file in files:
        path = atomic_write(Path(folder) / file.name, file.text)
        if file.executable:
            path.chmod(path.stat().st_mode | 0o111)
        written[file.role] = path
    return written
