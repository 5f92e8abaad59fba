"""Controller programs as files, text and documents."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from asbuilt.tables import wrapped
from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.programs.format import ProgramFile
from asbuilt.writers.programs.request import DRY_RUN_SLOWDOWN, ProgramRequest
from asbuilt.writers.tables.design_tables import margin_table, margin_verdict


def write_program(folder: str | os.PathLike[str], files: Sequence[ProgramFile]) -> dict[str, Path]:
    """Write the files of a program into a folder and return them by role.

    Scripts become executable.
    """
    written = {}
    for file in files:
        path = atomic_write(Path(folder) / file.name, file.text)
        if file.executable:
            path.chmod(path.stat().st_mode | 0o111)
        written[file.role] = path
    return written


def program_document(
    request: ProgramRequest, form: str, files: Mapping[str, Path]
) -> dict[str, Any]:
    """Return the JSON document of a program."""
    return {
        "robot": request.model.name,
        "format": form,
        "motion": request.name,
        "duration": request.motion.duration,
        "dry_run_duration": DRY_RUN_SLOWDOWN * request.motion.duration,
        "rate": request.rate,
        "start": request.motion.start.tolist(),
        "worst_margin": request.report.worst_margin,
        "collision_distance": None if request.clearance is None else request.clearance.distance,
        "files": path_texts(files),
    }


def program_text(request: ProgramRequest, form: str, *, full: bool = False) -> str:
    """Return a program as text: limits, what is not checked, margins."""
    known = request.clearance
    collisions = (
        "NOT CHECKED: collisions, and the approach to the start pose"
        if known is None
        else (
            f"smallest distance between bodies of {known.source} {1000 * known.distance:.0f} mm;"
            " NOT CHECKED: collisions with anything else, and the approach to the start pose"
        )
    )
    title = (
        f"{request.model.name} - {form} program of {request.name},"
        f" {request.motion.duration:.3f} s, dry run {request.dry_run.duration:.1f} s"
    )
    return "\n".join(
        [
            wrapped(title),
            wrapped(margin_verdict(request.report)),
            wrapped(collisions),
            "Run the dry run first; the header of the program says how.",
            "",
            margin_table(request.report).as_text(full).rstrip(),
        ]
    )
