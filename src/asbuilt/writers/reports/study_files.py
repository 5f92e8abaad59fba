"""Text, document and files of a study."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asbuilt import writers
from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.findings import Cure
from asbuilt.identification import (
    IdentificationResult,
    Payload,
    gear_ratios,
    motor_side_parameters,
)
from asbuilt.tables import wrap_text
from asbuilt.validation.prediction import Validation
from asbuilt.validation.verdicts.verdict import describe_payload_outcome
from asbuilt.workflow.study_result import Study
from asbuilt.writers.models.as_built import as_built, keep_described_drives, note_load_friction
from asbuilt.writers.tables.drive_tables import tabulate_motor_side
from asbuilt.writers.tables.payload_tables import (
    payload_document,
    payload_text,
    tabulate_payload,
)
from asbuilt.writers.tables.rollout_tables import describe_refinement, rollout_text
from asbuilt.writers.tables.tabular import (
    exported_masses,
    identify_document,
    tabulate_identified,
    tabulate_prediction,
    write_json,
)
from asbuilt.writing import atomic_write, file_set

if TYPE_CHECKING:
    from asbuilt.validation.recovery import Recovery

MEMBERS = (
    "result.json",
    "summary.txt",
    "parameters.csv",
    "payload.json",
    "torque.png",
    "cutoff.png",
    "report.html",
    "robot.toml",
    "robot.urdf",
)
"""Files of a study, which are replaced together."""


def study_text(
    study: Study,
    payload: Payload | None = None,
    *,
    full: bool = False,
    cure_text: Callable[[Cure], str] = str,
) -> str:
    """Return what `asbuilt identify` prints, with the payload if one was identified too.

    `cure_text` writes cures, for an interface that adds the names of its options.
    """
    if not full:
        text = study.summary().as_text(cure_text=cure_text)
        if payload is None:
            return text
        outcome = wrap_text(describe_payload_outcome(payload))
        return f"{text}\n{outcome}\n\n{tabulate_payload(payload).as_text()}"
    summary = study.summary()
    masses = exported_masses(study.result)
    if masses is not None:
        summary = summary.with_mass(masses.total, masses.links)
    result = study.result
    cutoffs = study.cutoffs
    refined = study.refined
    motors = motor_side_parameters(result) if gear_ratios(result.model) else None
    parts = [
        summary.as_text(full, cure_text),
        ""
        if motors is None
        else f"Drives at the motor\n{tabulate_motor_side(motors).as_text(full)}",
        "" if cutoffs is None else cutoffs.table().as_text(full),
        study.comparison.torque_table().as_text(full),
        wrap_text(study.comparison.verdict()) + "\n",
        rollout_text(result.model, study.rollouts, full=full).lstrip("\n"),
        "" if refined is None else describe_refinement(refined),
        "" if payload is None else payload_text(payload, full),
    ]
    return "\n".join(filter(None, parts))


def study_document(
    study: Study,
    files: Mapping[str, Path],
    notes: Mapping[str, Sequence[str]] | None = None,
    payload: Payload | None = None,
) -> dict[str, Any]:
    """Return what `asbuilt identify --json` prints; `notes` come from `write_study`."""
    cutoffs = study.cutoffs
    refined = study.refined
    optional = {
        "cutoff_sweep": None if cutoffs is None else cutoffs.as_document(),
        "rollout": [rollout.as_dict() for rollout in study.rollouts] or None,
        "refined": None if refined is None else refined.as_dict(),
        "payload": None if payload is None else payload_document(payload),
    }
    return (
        identify_document(study, files=files)
        | {"file_notes": {kind: list(texts) for kind, texts in (notes or {}).items()}}
        | {name: part for name, part in optional.items() if part is not None}
    )


def write_result(path: str | os.PathLike[str], result: IdentificationResult | Study) -> Path:
    """Write a result, or a study, as JSON that `read_result` reads back to the last bit."""
    return atomic_write(path, result.to_json())


def write_study(
    folder: str | Path,
    study: Study,
    *,
    payload: Payload | None = None,
    command: Sequence[str] = (),
    recovery: Recovery | None = None,
) -> tuple[dict[str, Path], dict[str, tuple[str, ...]]]:
    """Write the files of a study into a folder.

    These are result.json, summary.txt, parameters.csv and the robot as built, robot.toml;
    torque.png and report.html if there are samples, which studies of a ledger lack; cutoff.png and
    payload.json if there is one. If the robot came from a URDF and is physically consistent,
    robot.urdf is that file as built.

    Parameters
    ----------
    folder
        Where to write.
    study
        The study.
    payload
        What the flange carries, if that was identified too.
    command
        The command line that repeats the study.
    recovery
        The comparison with the truth, of a virtual robot; the report shows it.

    Returns
    -------
    tuple
        Paths by kind, and notes by kind: what a file cannot hold, or why it was not written.
    """
    folder = Path(folder)
    result = study.result
    shown = [*study.validations, *study.training]
    with file_set(folder, "result.json", MEMBERS, keep=result.model.source):
        files = {
            "result": write_result(folder / "result.json", study),
            "summary": atomic_write(folder / "summary.txt", study_text(study, payload, full=True)),
            "parameters": atomic_write(
                folder / "parameters.csv", tabulate_identified(result).as_csv()
            ),
        }
        if payload is not None:
            files["payload"] = write_json(folder / "payload.json", payload_document(payload))
        if shown:
            files["torque"] = _draw(folder / "torque.png", result, shown[0])
        if study.cutoffs is not None:
            drawn = writers.cutoff_figure(
                study.cutoffs, title=f"{result.robot}: cutoff of the low-pass"
            )
            files["cutoff"] = writers.save_figure(drawn, folder / "cutoff.png")
        if shown:
            files["report"] = writers.write_report(
                folder / "report.html",
                study,
                payload=payload,
                command=command,
                recovery=recovery,
            )
        robots, notes = _write_robot(folder, result)
        return files | robots, notes


def _write_robot(
    folder: Path, result: IdentificationResult
) -> tuple[dict[str, Path], dict[str, tuple[str, ...]]]:
    """Write robot.toml and robot.urdf, if there can be such, and note what they lack."""
    from asbuilt.writers.models.export import find_urdf_to_edit  # noqa: PLC0415 - light start
    from asbuilt.writers.models.physical import list_impossibilities  # noqa: PLC0415 - light start
    from asbuilt.writers.models.robot_toml import write_robot_toml  # noqa: PLC0415 - light start
    from asbuilt.writers.models.urdf import write_urdf  # noqa: PLC0415 - light start

    files: dict[str, Path] = {}
    notes: dict[str, tuple[str, ...]] = {}
    kind = "robot"
    try:
        built = as_built(result)
        files["robot"] = write_robot_toml(folder / "robot.toml", built.model)
        notes["robot"] = note_load_friction(result, built)
        kind = "urdf"
        original, missing = find_urdf_to_edit(result.model)
        in_simulators, kept = keep_described_drives(built.model, result.model)
        if original is None:
            notes["urdf"] = tuple(f"not written: {why}" for why in missing)
        elif impossible := list_impossibilities(built.model):
            notes["urdf"] = (
                f"not written: {impossible[0]}; the nearest consistent model can be exported",
            )
        else:
            files["urdf"], remarks = write_urdf(
                folder / "robot.urdf", in_simulators, original=original
            )
            notes["urdf"] = (*remarks, *kept)
    except (IdentifiabilityError, DescriptionError) as problem:
        why = "; ".join(filter(None, (problem.message, str(problem.cure or ""))))
        notes[kind] = (f"not written: {why}",)
    return files, {kind: remarks for kind, remarks in notes.items() if remarks}


def write_validations(
    folder: Path, result: IdentificationResult, validations: Sequence[Validation]
) -> dict[str, Path]:
    """Write for each validation its torques (CSV) and their figure (PNG).

    Returns the path of each, by kind.
    """
    files: dict[str, Path] = {}
    for k, validation in enumerate(validations, start=1):
        number = "" if len(validations) == 1 else f"_{k}"
        files[f"prediction{number}"] = atomic_write(
            folder / f"prediction{number}.csv", tabulate_prediction(validation).as_csv()
        )
        files[f"torque{number}"] = _draw(folder / f"torque{number}.png", result, validation)
    return files


def _draw(path: Path, result: IdentificationResult, shown: Validation) -> Path:
    figure = writers.torque_figure(
        shown.t,
        shown.measured,
        shown.predicted,
        cad=shown.predicted_cad,
        joint_names=shown.joint_names,
        units=shown.units,
        title=f"{result.robot}: {Path(shown.source).name}",
    )
    return writers.save_figure(figure, path)
