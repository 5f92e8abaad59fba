"""The identified robot for other software.

URDF, MJCF, C code and the robot file, all from one model.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.formats.xml import described_text, outermost_tag
from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.identification.bodies.standard_parameters import StandardParameters, random_motion_rows
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import significant
from asbuilt.validation.nearest_consistent import StandIn, stand_in
from asbuilt.writers.files import file_lines, path_texts
from asbuilt.writers.models.as_built import (
    AsBuilt,
    as_built,
    keeping_described_drives,
    load_counted,
)
from asbuilt.writers.models.c.c_code import write_c
from asbuilt.writers.models.mjcf import write_mjcf
from asbuilt.writers.models.physical import refuse_bad_stand_in, refuse_impossible_result
from asbuilt.writers.models.robot_toml import write_robot_toml
from asbuilt.writers.models.urdf import write_urdf

Place = str | os.PathLike[str]


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """Say which files were written, by kind, and for each what its reader must know.

    `cost` holds a model that is only the nearest possible against the identified one, on the
    recordings; None where the identified torques are kept exactly, or the result carries no
    cause data. `beyond` says how far apart the two are where no recording was.
    """

    robot: str
    verdict: str
    files: dict[str, Path]
    notes: dict[str, tuple[str, ...]]
    cost: StandIn | None = None
    beyond: str = ""

    def as_document(self) -> dict[str, Any]:
        """Return the export as plain texts and lists."""
        return {
            "robot": self.robot,
            "verdict": self.verdict,
            "files": path_texts(self.files),
            "notes": {kind: list(notes) for kind, notes in self.notes.items()},
            "cost": None if self.cost is None else self.cost.as_document(),
            "beyond": self.beyond,
        }

    def as_text(self) -> str:
        """Return the files and notes, one a line."""
        lines = [f"{self.robot} as built: {self.verdict}"]
        if self.cost is not None:
            lines += ["", *self.cost.table().as_text().splitlines(), ""]
        if self.beyond:
            lines += [self.beyond, ""]
        return "\n".join([*lines, *file_lines(self.files, self.notes, 9)])


def export_result(
    result: IdentificationResult,
    *,
    urdf: Place | None = None,
    mjcf: Place | None = None,
    toml: Place | None = None,
    c: Place | None = None,
    original: Place | None = None,
    nearest: bool = False,
    force: bool = False,
) -> Export:
    """Write the identified robot into each file asked for; a `.c` file comes with its header.

    `original` is the URDF that is edited; by default the description the robot was identified with,
    where that was a URDF and is still there. Without one the URDF is written afresh, without
    shapes. The standard parameters are real bodies that give the identified torques exactly and are
    closest to CAD; where there are none, `nearest` takes the real ones whose torque on the data
    used differs least.

    Raises
    ------
    InertiaError
        If no rigid bodies and drives can have this model, or the nearest that can predicts the
        recordings badly and `force` is not set; nothing is written then.
    UsageError
        If no file is asked for, or options do not go together.
    """
    if all(place is None for place in (urdf, mjcf, toml, c)):
        raise UsageError(
            "nothing to export: name at least one file with --urdf, --mjcf, --toml or --c"
        )
    if original is not None and urdf is None:
        raise UsageError("--original is the URDF to edit, so it needs --urdf FILE to write")
    if force and not nearest:
        raise UsageError(
            "--force writes the nearest possible robot whatever it costs, so it needs --nearest; an"
            " impossible robot is never written"
        )
    built = as_built(result, nearest=nearest)
    found, model = built.parameters, built.model
    refuse_impossible_result(result, model)
    cost = None if found.exact else stand_in(result, found.beta)
    if not (found.exact or force):
        refuse_bad_stand_in(result, found.beta, cost)
    files: dict[str, Path] = {}
    notes: dict[str, tuple[str, ...]] = {}
    (in_simulators, kept), load = (
        keeping_described_drives(model, result.model),
        load_note(result, built),
    )
    if c is not None:
        files["c"], files["header"] = write_c(
            c, model, drive=result.base.drive, drive_values=found.parameters[10 * model.n_joints :]
        )
        notes["c"] = load
    if urdf is not None:
        edited, missing = urdf_to_edit(result.model, original)
        files["urdf"], said = write_urdf(urdf, in_simulators, original=edited)
        notes["urdf"] = (*missing, *said, *kept)
    if mjcf is not None:
        files["mjcf"], said = write_mjcf(mjcf, in_simulators)
        notes["mjcf"] = (*said, *kept)
    if toml is not None:
        files["toml"] = write_robot_toml(toml, model)
        notes["toml"] = load
    said_of = {kind: said for kind, said in notes.items() if said}
    return Export(
        result.robot,
        found.verdict,
        files,
        said_of,
        cost,
        "" if found.exact else _beyond(result, found),
    )


def _beyond(result: IdentificationResult, found: StandardParameters) -> str:
    """Say how far apart the identified model and the one written are in random motion, and how sure
    the identified one is of itself there.
    """
    W = random_motion_rows(result.model, result.base)
    unsure = np.sqrt(np.mean(np.einsum("ij,jk,ik->i", W, result.covariance, W)))
    apart, of = (
        float(np.sqrt(np.mean(torque**2)))
        for torque in (found.torque_rms, found.torque_rms_of_motion)
    )
    return (
        f"In random motion, where no recording was, the two are {significant(apart, 2)} N m RMS"
        f" apart (of {significant(of)}); the standard error of the identified one is"
        f" {significant(float(unsure), 2)} N m there."
    )


def urdf_to_edit(
    model: RobotModel, given: Place | None = None
) -> tuple[Path | None, tuple[str, ...]]:
    """Return the URDF to edit.

    The one given, else the one that the robot was read from, None where there is none, with a note
    where there was one.
    """
    place = Path(given if given is not None else model.source)
    if given is not None or place.is_file():
        content, source = described_text(place)
        if outermost_tag(content) == "robot":
            return place, ()
        if given is not None:
            raise DescriptionError(
                f"{source} is no URDF; --original takes the URDF that the robot was identified with"
            )
        return None, ()
    if place.suffix.lower() == ".urdf":
        said = (
            f"the URDF it was identified with, {place}, is not there any more, so a fresh one"
            " without shapes was written; name it with --original"
        )
        return None, (said,)
    return None, ()


def load_note(result: IdentificationResult, built: AsBuilt) -> tuple[str, ...]:
    """Return a note where friction that depends on load is not quite that of the result."""
    apart = load_counted(result, built)
    if not apart:
        return ()
    return (
        (
            "load-dependent friction sees the load of the links alone; in the result the load"
            f" counts armatures that cannot be told from a link: up to {apart:.2g} N m of torque in"
            " random motion"
        ),
    )
