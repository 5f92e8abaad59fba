"""Export of the identified robot: URDF, MJCF, C code with observer, and robot file."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.formats.xml import described_text, find_outermost_tag
from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.findings import Cure
from asbuilt.identification import IdentificationResult, Identified, StandardParameters
from asbuilt.identification.information.random_states import build_random_motion_rows
from asbuilt.identification.result.torque_prediction import set_link_parameters
from asbuilt.registry import Registry
from asbuilt.tables import round_significant
from asbuilt.validation.prediction import name_torque_unit, torque_units
from asbuilt.validation.verdicts.model_errors import NearestModel, compare_with_nearest
from asbuilt.writers.files import file_lines, path_texts
from asbuilt.writers.models.as_built import (
    as_built,
    keep_described_drives,
    note_load_friction,
)
from asbuilt.writers.models.c.c_code import CCode, write_c
from asbuilt.writers.models.control import note_missing_gains
from asbuilt.writers.models.mjcf import (
    describe_rotors,
    mjcf_holds,
    write_mjcf,
    write_passive,
)
from asbuilt.writers.models.nearest_terms import NearestTerms, find_nearest_terms
from asbuilt.writers.models.physical import (
    note_implausible_links,
    refuse_inconsistent,
    refuse_poor_nearest_model,
    refuse_wrong_units,
)
from asbuilt.writers.models.robot_toml import write_robot_toml
from asbuilt.writers.models.simulator_format import SIMULATOR_FORMATS, ExportedDrives
from asbuilt.writers.models.urdf import urdf_holds, write_urdf

Place = str | os.PathLike[str]
ObserverCode = Callable[[IdentificationResult, Any], Callable[[str], CCode]]
"""Function of a result and thresholds, or their file, that returns a writer of an observer's code.

The writer takes the prefix of all names.
"""

OBSERVERS: Registry[ObserverCode] = Registry("C observer", None, "asbuilt.c_observers")
"""Observers that C code of a robot as built may have."""


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """Hold the files written, by kind, with notes.

    Parameters
    ----------
    robot, verdict
        Name of the robot, and what its standard parameters are.
    files, notes
        Path and notes of each kind of file.
    cost
        Errors of the nearest consistent model on the recordings; None if the identified torques
        are exact or the result has no cause data.
    beyond
        Torque difference of the two models in random motion, as a sentence.
    lost
        What URDF and MJCF lack of the torque of each joint, by kind.
    """

    robot: str
    verdict: str
    files: dict[str, Path]
    notes: dict[str, tuple[str, ...]]
    cost: NearestModel | None = None
    beyond: str = ""
    lost: Mapping[str, NearestTerms] = field(default_factory=dict)

    def as_document(self) -> dict[str, Any]:
        """Return the export as plain texts and lists."""
        return {
            "robot": self.robot,
            "verdict": self.verdict,
            "files": path_texts(self.files),
            "notes": {kind: list(notes) for kind, notes in self.notes.items()},
            "cost": None if self.cost is None else self.cost.as_document(),
            "beyond": self.beyond,
            "lost": {kind: each.as_document() for kind, each in self.lost.items()},
        }

    def as_text(self) -> str:
        """Return the files and notes, one a line."""
        lines = [
            f"{self.robot} as built: {self.verdict}",
            *([] if self.cost is None else ["", *self.cost.table().as_text().splitlines(), ""]),
            *([self.beyond, ""] if self.beyond else []),
            *file_lines(self.files, self.notes, 9),
        ]
        return "\n".join(lines)


def export_result(
    result: IdentificationResult | Identified,
    *,
    urdf: Place | None = None,
    mjcf: Place | None = None,
    toml: Place | None = None,
    c: Place | None = None,
    observer: Place | None = None,
    thresholds: Any = None,
    original: Place | None = None,
    nearest: bool = False,
    force: bool = False,
    simulators: Mapping[str, Place] | None = None,
    elastic: bool = False,
) -> Export:
    """Write the identified robot into the files named.

    The links are closest to CAD within the noise of the torques of the data used.

    Parameters
    ----------
    result
        The identified robot, or its study.
    urdf, mjcf, toml, c
        Files to write; a `.c` file comes with its header.
    observer, thresholds
        C file to write with the momentum observer and the dynamics it needs, and its thresholds or
        the file that `asbuilt watch` wrote them to.
        Its parameters are the identified ones, whether or not they are physically consistent.
    original
        URDF to edit; by default the description that the robot was identified with. Without one a
        URDF without shapes is written.
    nearest
        If the identified parameters are physically inconsistent, write the nearest consistent
        model: that with the least torque difference on the data used.
    force
        Write the nearest consistent model however large its error.
    simulators
        Files to write by simulator format (`SIMULATOR_FORMATS`), such as `"isaac-lab"`.
    elastic
        Write a joint for each motor and one for its link into MJCF, where two encoders determine
        the stiffness between them.

    Returns
    -------
    Export
        The files, with notes on what each cannot hold.

    Raises
    ------
    InertiaError
        If the model is physically inconsistent, its description is in other units, or the nearest
        consistent one predicts the recordings badly and `force` is not set: nothing is written.
    UsageError
        If no file is named, or options do not go together.
    """
    result = result.result
    formats = {SIMULATOR_FORMATS.find(key): place for key, place in (simulators or {}).items()}
    models = (urdf, mjcf, toml, c)
    # Each refusal has its cure; nothing is written before all are passed.
    for refused, why, cure, settings in (
        (
            all(place is None for place in (*models, observer)) and not formats,
            "no file to export is named",
            "name at least one",
            dict.fromkeys(("urdf", "mjcf", "toml", "c", "observer"), "FILE"),
        ),
        (
            original is not None and urdf is None,
            f"{original} is to be edited, but no URDF to write is named",
            "name the URDF to write",
            {"urdf": "FILE"},
        ),
        (
            force and not nearest,
            "force applies to the nearest consistent model, which is not asked for",
            "ask for it",
            {"nearest": True},
        ),
        (
            thresholds is not None and observer is None,
            "thresholds go with an observer, but no file for it is named",
            "name it",
            {"observer": "FILE"},
        ),
        (
            elastic and mjcf is None,
            "elastic joints are written into MJCF, but no such file is named",
            "name it",
            {"mjcf": "FILE"},
        ),
    ):
        if refused:
            raise UsageError(why, cure=Cure(cure, settings))
    # Rotors of two encoders are described before anything is written.
    result = describe_rotors(result) if elastic else result
    files: dict[str, Path] = {}
    notes: dict[str, tuple[str, ...]] = {}
    # The observer has the identified parameters exactly, consistent or not.
    if observer is not None:
        files["observer"], files["observer_header"] = write_observer(
            observer, result, thresholds=thresholds
        )
    for exact in [choice for choice in formats if choice.exact]:
        files[exact.key], notes[exact.key] = exact.write(
            ExportedDrives(result.model, result), Path(formats.pop(exact))
        )
    if all(place is None for place in models) and not formats:
        return Export(result.robot, "the identified parameters", files, notes)
    built = as_built(result, nearest=nearest)
    found = built.parameters
    model = built.model
    # Nothing is written of an inconsistent robot.
    refuse_inconsistent(model, result)
    refuse_wrong_units(result.model)
    absurd = note_implausible_links(model)
    cost = compare_with_nearest(result, found.beta) if found.substituted else None
    if found.substituted and not force:
        refuse_poor_nearest_model(result, found.beta, cost)
    # Simulators need values of all drives; C and robot file state what was identified.
    in_simulators, kept = keep_described_drives(model, result.model)
    load = note_load_friction(result, built)
    if c is not None:
        files["c"], files["header"] = write_c(
            c, model, drive=result.base.drive, drive_values=found.parameters[10 * model.n_links :]
        )
        notes["c"] = load
    lost = dict[str, NearestTerms]()
    if urdf is not None:
        edited, missing = find_urdf_to_edit(result.model, original)
        lost["urdf"] = nearest_terms = find_nearest_terms(
            result, built, in_simulators, urdf_holds, gravity=False
        )
        told = nearest_terms.notes("URDF", "C code and the robot file hold everything")
        files["urdf"], remarks = write_urdf(
            urdf, nearest_terms.model, original=edited, remarks=told
        )
        notes["urdf"] = (*missing, *told, *remarks, *kept, *note_missing_gains(result, "urdf"))
    if mjcf is not None:
        lost["mjcf"] = nearest_terms = find_nearest_terms(result, built, in_simulators, mjcf_holds)
        passive, told = _write_passive(mjcf, in_simulators, nearest_terms, elastic=elastic)
        files |= passive
        files["mjcf"], remarks = write_mjcf(
            mjcf,
            replace(nearest_terms.model, notes=(*in_simulators.notes, *told)),
            result.encoders if elastic else (),
        )
        notes["mjcf"] = (
            *told,
            *remarks,
            *kept,
            *note_missing_gains(result, "mjcf"),
            *note_held_base(result.model),
        )
    if toml is not None:
        files["toml"] = write_robot_toml(toml, model)
        notes["toml"] = load
    for written, place in formats.items():
        files[written.key], remarks = written.write(
            ExportedDrives(in_simulators, result), Path(place)
        )
        notes[written.key] = (*remarks, *kept)
    notes = {kind: (*absurd, *notes.get(kind, ())) for kind in files}
    return Export(
        result.robot,
        found.verdict,
        files,
        {kind: remarks for kind, remarks in notes.items() if remarks},
        cost,
        _describe_difference(result, found) if found.substituted else "",
        lost,
    )


def _write_passive(
    mjcf: Place, robot: RobotModel, nearest: NearestTerms, *, elastic: bool
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Write what MJCF lacks as a callback of MuJoCo beside it; return the file, and notes.

    A load that several joints share, or one behind a spring, is none of the torques in MuJoCo.
    """
    if not nearest.replaced:
        return {}, nearest.notes("MJCF", "C code and the robot file hold everything")
    if robot.tree is not robot or elastic:
        return {}, nearest.notes("MJCF", "C code and the robot file hold them")
    place = Path(mjcf)
    path = place.with_name(re.sub(r"\W", "_", place.stem) + "_passive.py")
    written = write_passive(path, robot, nearest.replaced, mjcf)
    return {"mjcf_passive": written}, nearest.notes(
        "MJCF", f"{written.name} beside it adds them to MuJoCo: {written.stem}.attach(model)"
    )


def _describe_difference(result: IdentificationResult, found: StandardParameters) -> str:
    """Return the torque difference of the two models in random motion, with its error."""
    W = build_random_motion_rows(result.model, result.base)
    # Error of the torque by that of the parameters, over the rows.
    error = np.sqrt(np.mean(np.einsum("ij,jk,ik->i", W, result.covariance, W)))
    apart, of = (
        float(np.sqrt(np.mean(torque**2)))
        for torque in (found.torque_rms, found.torque_rms_of_motion)
    )
    unit = name_torque_unit(torque_units(result.model))
    return (
        f"In random motion the torques of the two models differ by {round_significant(apart, 2)}"
        f" {unit} RMS (of {round_significant(of)}); the standard error of the identified torque"
        f" there is {round_significant(float(error), 2)} {unit}."
    )


def find_urdf_to_edit(
    model: RobotModel, given: Place | None = None
) -> tuple[Path | None, tuple[str, ...]]:
    """Return the URDF to edit, given or the robot's, and a note if that is missing."""
    place = Path(given if given is not None else model.source)
    if given is None and not place.is_file():
        note = (
            f"{place}, with which the robot was identified, does not exist: a URDF without shapes"
            " was written; name the original to keep its shapes"
        )
        # Of other formats nobody expects a URDF to be edited.
        return None, (note,) if place.suffix.lower() == ".urdf" else ()
    content, source = described_text(place)
    if find_outermost_tag(content) == "robot":
        return place, ()
    if given is None:
        return None, ()
    raise DescriptionError(
        f"{source} is no URDF",
        cure=Cure("give the URDF that the robot was identified with"),
        file=source,
    )


def note_held_base(model: RobotModel) -> tuple[str, ...]:
    """Return what a model file lacks of a robot whose free joint was held."""
    return tuple(
        f"{note}: the file has no free joint and no trunk; put its bodies under yours"
        for note in model.notes
        if note.startswith("the free joint of ")
        # The note of any one base says it all.
    )[:1]


def write_observer(
    path: str | os.PathLike[str],
    result: IdentificationResult,
    *,
    # Parameters of links that have exactly the identified base parameters.
    thresholds: Any = None,
) -> tuple[Path, Path]:
    """Write `NAME.c` and `NAME.h` with the dynamics of the robot as built and its observer.

    The parameters are exactly the identified ones, also where no physically consistent links have
    them. Returns both paths.

    Raises
    ------
    UsageError
        If the file is not named `.c`, thresholds belong to other joints, or no observer is
        installed.
    """
    observer = OBSERVERS.find("momentum")(result, thresholds)
    torque = result.torque_model
    model = set_link_parameters(result.model, result.base, result.estimates)
    return write_c(path, model, drive=torque.drive, drive_values=torque.values, observer=observer)
