"""Programs for controllers as files in a folder."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.programs.request import DRY_RUN_SLOWDOWN, ProgramFile, ProgramRequest


def write_program(folder: str | os.PathLike[str], files: Sequence[ProgramFile]) -> dict[str, Path]:
    """Write the files of a program, each whole or not at all, and return them by role.

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
    """Return what `asbuilt program --json` prints."""
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


def program_text(request: ProgramRequest, form: str) -> str:
    """Return what `asbuilt program` prints."""
    known = request.clearance
    collisions = (
        "NOT checked: collisions, and the way to the start pose."
        if known is None
        else (
            f"Bodies of {known.source} come no nearer than {1000 * known.distance:.0f} mm on the"
            " motion. NOT checked: collisions with anything else, and the way to the start pose."
        )
    )
    return "\n".join(
        (
            (
                f"{form} program of {request.name} for {request.model.name}:"
                f" {request.motion.duration:.3f} s, dry run {request.dry_run.duration:.1f} s"
            ),
            str(request.report),
            f"{collisions} Run the dry run first; the header of the program says how.",
        )
    )
