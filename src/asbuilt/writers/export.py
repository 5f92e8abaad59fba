"""The identified robot for other software: URDF, MJCF, C code and the robot file, all from one model."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asbuilt.description.model import DriveValues, RobotModel
from asbuilt.description.xml import described_text, outermost_tag
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.identification.result import IdentificationResult
from asbuilt.writers.c_code import write_c
from asbuilt.writers.mjcf import write_mjcf
from asbuilt.writers.physical import refuse_impossible
from asbuilt.writers.robot_toml import as_built_model, as_built_parameters, write_robot_toml
from asbuilt.writers.urdf import write_urdf

Array = NDArray[np.float64]
Place = str | os.PathLike[str]


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """Say which files were written, by kind, and for each what its reader must know."""

    robot: str
    verdict: str
    files: dict[str, Path]
    notes: dict[str, tuple[str, ...]]

    def as_document(self) -> dict[str, Any]:
        """Return the export as plain texts and lists."""
        return {
            "robot": self.robot,
            "verdict": self.verdict,
            "files": {kind: str(path) for kind, path in self.files.items()},
            "notes": {kind: list(notes) for kind, notes in self.notes.items()},
        }

    def as_text(self) -> str:
        """Return the files and notes, one a line."""
        lines = [f"{self.robot} as built: {self.verdict}"]
        for kind, path in self.files.items():
            lines += [f"  {kind:<9} {path}", *[f"            note: {note}" for note in self.notes.get(kind, ())]]
        return "\n".join(lines)


def export_result(
    result: IdentificationResult,
    *,
    urdf: Place | None = None,
    mjcf: Place | None = None,
    toml: Place | None = None,
    c: Place | None = None,
    original: Place | None = None,
    nearest: bool = False,
) -> Export:
    """Write the identified robot into each file asked for; a `.c` file comes with its header.

    `original` is the URDF that is edited; by default the description the robot was identified with, where that was a URDF and is still there.
    Without one the URDF is written afresh, without shapes. The standard parameters are real bodies that give the identified torques exactly and are
    closest to CAD; where there are none, `nearest` takes the real ones that lose least of the fit.

    Raises
    ------
    InertiaError
        If no rigid bodies and drives can have this model; nothing is written then.
    UsageError
        If no file is asked for.
    """
    if all(place is None for place in (urdf, mjcf, toml, c)):
        raise UsageError("nothing to export: name at least one file with --urdf, --mjcf, --toml or --c")
    if original is not None and urdf is None:
        raise UsageError("--original is the URDF to edit, so it needs --urdf FILE to write")
    found, model = as_built_parameters(result, nearest=nearest), as_built_model(result, nearest=nearest)
    refuse_impossible(model, "write the nearest possible robot (--nearest)")
    files: dict[str, Path] = {}
    notes: dict[str, tuple[str, ...]] = {}
    carried = (*_left_out(result.base.drive), *_kept(result))
    if c is not None:
        files["c"], files["header"] = write_c(c, model, drive=result.base.drive, drive_values=found.parameters[10 * model.n_joints :])
    if urdf is not None:
        edited, missing = urdf_to_edit(result.model, original)
        files["urdf"], said = write_urdf(urdf, model, original=edited)
        notes["urdf"] = (*missing, *said, *carried)
    if mjcf is not None:
        files["mjcf"], said = write_mjcf(mjcf, model)
        notes["mjcf"] = (*said, *carried)
    if toml is not None:
        files["toml"] = write_robot_toml(toml, model)
        notes["toml"] = carried
    return Export(result.robot, found.verdict, files, {kind: said for kind, said in notes.items() if said})


def urdf_to_edit(model: RobotModel, given: Place | None = None) -> tuple[Path | None, tuple[str, ...]]:
    """Return the URDF to edit: the one given, else the one that the robot was read from, None where there is none, with a note where there was one."""
    place = Path(given if given is not None else model.source)
    if given is not None or place.is_file():
        content, source = described_text(place)
        if outermost_tag(content) == "robot":
            return place, ()
        if given is not None:
            raise DescriptionError(f"{source} is no URDF; --original takes the URDF that the robot was identified with")
        return None, ()
    if place.suffix.lower() == ".urdf":
        said = f"the URDF it was identified with, {place}, is not there any more, so a fresh one without shapes was written; name it with --original"
        return None, (said,)
    return None, ()


def _left_out(drive: DriveSet) -> tuple[str, ...]:
    lost = [key for key in drive.keys if key not in DriveValues.__dataclass_fields__]
    return (f"the identified drive terms {', '.join(lost)} have no place in this file and are left out",) if lost else ()


def _kept(result: IdentificationResult) -> tuple[str, ...]:
    """Return a note where drive values of the description stay in the file without having been identified."""
    stated = [
        key
        for key in ("armature", "viscous", "coulomb", "offset")
        if key not in result.base.drive.keys and any(getattr(joint.drive, key) for joint in result.model.joints)
    ]
    return (f"not identified, and as described: {', '.join(stated)} of the drives",) if stated else ()
