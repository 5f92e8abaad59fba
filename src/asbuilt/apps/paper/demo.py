"""The demonstration: a complete run on a bundled robot, from the motion to the report."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt import (
    AsbuiltError,
    Design,
    DesignOptions,
    DriveSet,
    LinkInertia,
    MissingExtraError,
    RobotModel,
    Study,
    StudyOptions,
    design_motion,
    identify,
    random_fourier,
    write_motion,
    write_study,
)
from asbuilt.description import bundled_robot
from asbuilt.excitation import Motion, SearchProgress
from asbuilt.experiment import PERFECT_SENSORS, DataLogger, SimulatedRecording, VirtualRobot
from asbuilt.findings import join_names
from asbuilt.tables import Column, Table, format_share, round_significant, wrap_text
from asbuilt.validation import Attribution, Recovery, attribute, compare_with_truth
from asbuilt.workflow import Progress
from asbuilt.writers import (
    Export,
    design_document,
    export_result,
    identify_document,
    path_texts,
    simulate_document,
    write_motion_report,
    write_simulation,
)

ROBOT = "kuka-iiwa7-r800"
SEED = 7
DRIVE = "viscous,coulomb,offset"
STARTS = 12
"""Random starts of the design; those of 48 have 0.7 % more efficiency and take twice as long."""
GRIPPER = LinkInertia.from_com(1.2, [0.01, -0.01, 0.07], np.diag([0.004, 0.0035, 0.0015]))
"""Body at the flange of the virtual robot that its description lacks."""


@dataclass(frozen=True, slots=True, eq=False)
class Demo:
    """Hold the demonstration: motion, recordings, study, export and files.

    `recovery` compares the result with the truth; None without MuJoCo. `refusal` says why nothing
    was exported.
    """

    model: RobotModel
    design: Design
    training: SimulatedRecording
    study: Study
    recovery: Recovery | None
    causes: Attribution
    export: Export | None
    refusal: str
    files: Mapping[str, Path]
    seconds: float


def run_demo(folder: Path, *, progress: Progress | None = None) -> Demo:
    """Run the demonstration and write its files below a folder.

    Parameters
    ----------
    folder
        Where the files go.
    progress
        Called with the name of each step and the fraction done.

    Returns
    -------
    Demo
        What was designed, recorded, identified and written.
    """
    report = progress or (lambda what, fraction: None)
    started = time.perf_counter()
    model = bundled_robot(ROBOT)
    drive = DriveSet.parse(DRIVE)

    def searched(state: SearchProgress) -> None:
        report("design a motion", state.share)

    report("design a motion", 0.0)
    design = design_motion(
        model,
        DesignOptions(size=5, duration=20.0, drive=str(drive), seed=SEED, starts=STARTS),
        progress=searched,
    )
    report("record the robot", 0.0)
    training = _record(model, design.motion, SEED, "designed motion")
    test = _record(model, random_fourier(model, SEED, n_harmonics=4), SEED + 1, "another motion")
    study = identify(
        model,
        [training.recording],
        validation=[test.recording],
        options=StudyOptions(drive=drive, method="auto"),
        progress=report,
    )
    recovery = _compare_with_truth(model, study)
    report("write", 0.0)
    files = {
        "motion": write_motion(folder / "motion.csv", design.motion, model.joint_names),
        "motion_page": write_motion_report(folder / "motion.html", design),
        **write_simulation(folder / "recording.csv", training),
        "validation": write_simulation(folder / "validation.csv", test)["recording"],
        **write_study(folder, study, command=("demo", "--out", str(folder)), recovery=recovery)[0],
    }
    export = None
    refusal = ""
    try:
        export = export_result(
            study.result,
            urdf=folder / "as_built.urdf",
            mjcf=folder / "as_built.xml",
            c=folder / "as_built.c",
        )
        files |= export.files
    except AsbuiltError as problem:
        refusal = str(problem)
    report("write", 1.0)
    return Demo(
        model=model,
        design=design,
        training=training,
        study=study,
        recovery=recovery,
        causes=study.attribution or attribute(study.result),
        export=export,
        refusal=refusal,
        files=files,
        seconds=time.perf_counter() - started,
    )


def _record(model: RobotModel, motion: Motion, seed: int, name: str) -> SimulatedRecording:
    """Record the virtual robot in MuJoCo, or by inverse dynamics if that is not installed."""
    try:
        simulated = _build_virtual_robot(model).record(motion, seed)
    except MissingExtraError:
        robot = VirtualRobot.typical(model, SEED).with_tool(GRIPPER, at="flange")
        simulated = robot.record(motion, seed)
    return replace(simulated, recording=replace(simulated.recording, source=name))


def _build_virtual_robot(model: RobotModel) -> VirtualRobot:
    return VirtualRobot.preset("lab", model, SEED, tool=GRIPPER, at="flange")


def _compare_with_truth(model: RobotModel, study: Study) -> Recovery | None:
    """Compare the result with the true parameters, on a motion of its own without sensor noise."""
    robot = _build_virtual_robot(model)
    bare = replace(
        robot, sensors=PERFECT_SENSORS, logger=DataLogger(rate=100.0, accelerations=True)
    )
    try:
        clean = bare.record(random_fourier(model, SEED + 1), SEED)
    except MissingExtraError:
        return None
    return compare_with_truth(study.result, replace(clean, truth=robot.truth))


def describe_demo(story: Demo) -> str:
    """Return the screen with which the demonstration ends."""
    result = story.study.result
    design = story.design
    held = story.study.validations[0]
    consistent = "physically consistent" if result.physically_consistent else "NOT CONSISTENT"
    cad = held.metrics_cad
    built = held.metrics_as_built
    causes = story.causes
    rows = (("CAD", *cad.rms.tolist()), ("as built", *built.rms.tolist()))
    units = zip(held.joint_names, held.units, strict=True)
    columns = (
        Column("RMS error"),
        *(Column(name, unit, "decimal", ".3f") for name, unit in units),
    )
    truth = []
    recovery = story.recovery
    if recovery is not None:
        count = len(recovery.names)
        text = (
            f"{round(recovery.within(2.0) * count)} of {count} parameters within 2 standard errors;"
            f" torque without noise: CAD {format_share(recovery.cad_error)} off, as built"
            f" {format_share(recovery.torque_error, 2)}"
        )
        truth = [_format_line("truth", text), _describe_intervals(recovery)]
    # Joints whose error the text explains; the report has all.
    worst = [int(k) for k in np.argsort(-causes.rms_cad)[:3]]
    lines = [
        wrap_text(
            f"{story.model.name} with a gripper of {GRIPPER.mass:g} kg, other links and friction"
            " that its CAD lacks"
        ),
        "",
        _format_line(
            "designed",
            f"{design.motion.duration:g} s of motion in {design.solve_seconds:.0f} s, scaled"
            f" condition number {round_significant(design.scaled_condition_number)}, within every"
            " limit",
        ),
        _format_line("recorded", "; ".join(story.training.recording.notes)),
        _format_line(
            "identified",
            f"{result.rank} of {result.n_base} parameters by {result.method} from"
            f" {result.n_samples} samples, {consistent}",
        ),
        _format_line(
            "validated",
            f"on another motion: torque error CAD {format_share(cad.relative_error)}, as built"
            f" {format_share(built.relative_error)}",
        ),
        *truth,
        "",
        Table(columns, rows).as_text(),
        f"Causes of the error of CAD, at the {len(worst)} joints where it is largest:",
        *(wrap_text(causes.sentences[k], "  ", lines=2) for k in worst),
        "",
        _format_line(
            "exported", story.refusal or "URDF, MJCF and C code with the identified torques"
        ),
        _format_line("files", f"{len(story.files)} in {story.files['report'].parent}"),
        _format_line("report", f"{story.files['report']} (open it first)"),
    ]
    return "\n".join(lines) + "\n"


def _describe_intervals(recovery: Recovery) -> str:
    """Return how many feasible intervals hold the truth, and those of all and the last link."""
    masses = [interval for interval in recovery.intervals if interval.quantity.startswith("mass")]
    texts = [
        f"{interval.quantity} {interval.text} (true"
        f" {round_significant(recovery.true_values[interval.quantity])}, CAD"
        f" {round_significant(interval.cad)})"
        for interval in (masses[0], masses[-1])
    ]
    held = f"{recovery.held} of {len(recovery.intervals)} feasible intervals hold the truth"
    return _format_line("bodies", f"{held}: {join_names(texts)}")


def _format_line(label: str, text: str) -> str:
    return wrap_text(text, f"{label:<12}")


def demo_document(story: Demo) -> dict[str, Any]:
    """Return what `asbuilt demo --json` prints."""
    return {
        "excite": design_document(story.design, {}),
        "simulate": simulate_document(story.training, {}),
        "identify": identify_document(story.study),
        "compare": (
            story.study.comparison.as_document() | {"attribution": story.causes.as_document()}
        ),
        "truth": (
            None
            if story.recovery is None
            else {
                "within_2_sigma": story.recovery.within(2.0),
                "torque_error": story.recovery.torque_error,
                "cad_error": story.recovery.cad_error,
                "intervals": [
                    interval.as_dict() | {"truth": story.recovery.true_values[interval.quantity]}
                    for interval in story.recovery.intervals
                ],
            }
        ),
        "export": None if story.export is None else story.export.as_document(),
        "files": path_texts(story.files),
        "seconds": story.seconds,
    }
