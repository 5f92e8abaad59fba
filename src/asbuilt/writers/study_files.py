"""Everything that an identification leaves behind: on the screen and in a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.identification.motor_side import gear_ratios, motor_side_parameters
from asbuilt.identification.result import IdentificationResult
from asbuilt.tables import stacked
from asbuilt.validation.prediction import Validation
from asbuilt.validation.study import Study
from asbuilt.writers.as_built import as_built_model, keeping_described_drives
from asbuilt.writers.cutoff_figure import cutoff_figure
from asbuilt.writers.drive_tables import motor_side_table
from asbuilt.writers.export import urdf_to_edit
from asbuilt.writers.figure_style import save_figure
from asbuilt.writers.figures import torque_figure
from asbuilt.writers.files import atomic_write
from asbuilt.writers.physical import impossibilities
from asbuilt.writers.report import write_report
from asbuilt.writers.robot_toml import write_robot_toml
from asbuilt.writers.tabular import identify_document, prediction_table, write_parameters_csv
from asbuilt.writers.urdf import write_urdf


def study_text(study: Study) -> str:
    """Return what `asbuilt identify` prints: the summary, torque errors of CAD and as built, and the verdict."""
    parts = [study.result.summary().as_text()]
    if gear_ratios(study.result.model):
        parts.append("Drives at the motor\n" + motor_side_table(motor_side_parameters(study.result)).as_text())
    if study.cutoffs is not None:
        parts.append(study.cutoffs.table().as_text())
    return "\n".join([*parts, stacked([study.comparison.torque_table()]), study.comparison.verdict()])


def study_document(study: Study, files: Mapping[str, Path]) -> dict[str, Any]:
    """Return what `asbuilt identify --json` prints."""
    document = identify_document(study.result, files=files)
    return document if study.cutoffs is None else document | {"cutoff_sweep": study.cutoffs.as_document()}


def write_study(folder: Path, study: Study, *, command: Sequence[str] = ()) -> dict[str, Path]:
    """Write result.json, summary.txt, parameters.csv, torque.png, report.html and the robot as built, robot.toml.

    Where the robot came from a URDF and real bodies have these parameters, robot.urdf is that file as built; a robot that cannot be made whole, or whose URDF has changed since, has
    neither. Returns the path of each, by kind; `command` is the command line that repeats the study.
    """
    result = study.result
    files = {
        "result": atomic_write(folder / "result.json", result.to_json()),
        "summary": atomic_write(folder / "summary.txt", study_text(study)),
        "parameters": write_parameters_csv(folder / "parameters.csv", result),
    }
    files["torque"] = _draw(folder / "torque.png", result, (study.validations or study.training)[0])
    if study.cutoffs is not None:
        files["cutoff"] = save_figure(cutoff_figure(study.cutoffs, title=f"{result.robot}: cutoff of the low-pass"), folder / "cutoff.png")
    files["report"] = write_report(
        folder / "report.html", result, study.validations, fitted=study.training, attribution=study.attribution, command=command
    )
    try:
        robot = as_built_model(result)
        files["robot"] = write_robot_toml(folder / "robot.toml", robot)
        original, _ = urdf_to_edit(result.model)
        if original is not None and not impossibilities(robot):
            files["urdf"], _ = write_urdf(folder / "robot.urdf", keeping_described_drives(robot, result.model)[0], original=original)
    except (IdentifiabilityError, DescriptionError):
        return files
    return files


def write_validations(folder: Path, result: IdentificationResult, validations: Sequence[Validation]) -> dict[str, Path]:
    """Write for each validation its torques (CSV) and their figure (PNG); returns the path of each, by kind."""
    files: dict[str, Path] = {}
    for k, validation in enumerate(validations, start=1):
        number = "" if len(validations) == 1 else f"_{k}"
        files[f"prediction{number}"] = atomic_write(folder / f"prediction{number}.csv", prediction_table(validation).as_csv())
        files[f"torque{number}"] = _draw(folder / f"torque{number}.png", result, validation)
    return files


def _draw(path: Path, result: IdentificationResult, shown: Validation) -> Path:
    figure = torque_figure(
        shown.t,
        shown.measured,
        shown.predicted,
        cad=shown.predicted_cad,
        joint_names=shown.joint_names,
        units=shown.units,
        title=f"{result.robot}: {Path(shown.source).name}",
    )
    return save_figure(figure, path)
