"""Everything that an identification leaves behind: on the screen and in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asbuilt.errors import AsbuiltError
from asbuilt.tables import stacked
from asbuilt.validation.study import Study
from asbuilt.writers.figures import save_figure, torque_figure
from asbuilt.writers.files import atomic_write
from asbuilt.writers.report import write_report
from asbuilt.writers.robot_toml import as_built_model, write_robot_toml
from asbuilt.writers.tabular import write_parameters_csv


def study_text(study: Study) -> str:
    """Return what `asbuilt identify` prints: the summary, torque errors of CAD and as built, and the verdict."""
    return "\n".join([study.result.summary().as_text(), stacked([study.comparison.torque_table()]), study.comparison.verdict()])


def write_study(folder: Path, study: Study, *, command: Sequence[str] = ()) -> dict[str, Path]:
    """Write result.json, summary.txt, parameters.csv, torque.png, report.html and, where real bodies have these parameters, robot.toml.

    Returns the path of each, by kind; `command` is the command line that repeats the study.
    """
    result = study.result
    files = {
        "result": atomic_write(folder / "result.json", result.to_json()),
        "summary": atomic_write(folder / "summary.txt", study_text(study)),
        "parameters": write_parameters_csv(folder / "parameters.csv", result),
    }
    shown = (study.validations or study.training)[0]
    figure = torque_figure(
        shown.t,
        shown.measured,
        shown.predicted,
        joint_names=shown.joint_names,
        units=shown.units,
        title=f"{result.robot}: {shown.source}",
    )
    files["torque"] = save_figure(figure, folder / "torque.png")
    files["report"] = write_report(folder / "report.html", result, [*study.validations, *study.training], command=command)
    try:
        files["robot"] = write_robot_toml(folder / "robot.toml", as_built_model(result))
    except AsbuiltError:
        return files
    return files
