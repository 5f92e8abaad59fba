"""The whole story on bundled data.

Design a motion, record a virtual robot, identify, validate, compare, export, write everything down.
"""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.catalogue import bundled_robot
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.errors import AsbuiltError, MissingExtraError
from asbuilt.excitation.design.design import design_motion
from asbuilt.excitation.design.designed_motion import Design
from asbuilt.excitation.design.multistart import SearchProgress
from asbuilt.excitation.design.options import DesignOptions
from asbuilt.excitation.motions.motion import Motion
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.data_logger import DataLogger
from asbuilt.experiment.virtual.sensors import PERFECT_SENSORS
from asbuilt.experiment.virtual.virtual_robot import SimulatedRecording, VirtualRobot
from asbuilt.tables import share, significant, stacked
from asbuilt.validation.attribution.attribution import Attribution, attribute
from asbuilt.validation.recovery import Recovery, compare_with_truth
from asbuilt.workflow.study import Study, StudyOptions, identify
from asbuilt.writers.files import path_texts
from asbuilt.writers.models.export import Export, export_result
from asbuilt.writers.recording_files import simulate_document, write_simulation
from asbuilt.writers.reports.study_files import write_study
from asbuilt.writers.tables.design_tables import excite_document, write_design
from asbuilt.writers.tables.tabular import identify_document

Progress = Callable[[str, float], None]

ROBOT = "kuka-iiwa7-r800"
SEED = 7
DRIVE = "viscous,coulomb,offset"
SEARCH_SECONDS = 15.0
GRIPPER = LinkInertia.from_com(1.2, [0.01, -0.01, 0.07], np.diag([0.004, 0.0035, 0.0015]))
"""What the virtual robot carries and its description does not know."""
JOINTS_EXPLAINED = 3
"""Joints whose error the screen explains; the report has all."""
WIDTH = 140
"""Longest line of a sentence on the screen."""


@dataclass(frozen=True, slots=True, eq=False)
class Demo:
    """Hold the story: the motion designed, both recordings, the study of them, what was found of
    the truth, what was exported, the files written.

    `recovery` is None without MuJoCo, whose robot alone logs torques with the drive terms that are
    identified.
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


def run_demo(
    folder: Path, *, progress: Progress | None = None, search_seconds: float = SEARCH_SECONDS
) -> Demo:
    """Run the story and write its files below `folder`."""
    report = progress or (lambda what, fraction: None)
    started = time.perf_counter()
    model, drive = bundled_robot(ROBOT), DriveSet.parse(DRIVE)

    def searched(state: SearchProgress) -> None:
        report("design a motion", min((time.perf_counter() - started) / search_seconds, 1.0))

    report("design a motion", 0.0)
    design = design_motion(
        model,
        DesignOptions(
            size=5, duration=20.0, drive=str(drive), seed=SEED, time_limit=search_seconds
        ),
        progress=searched,
    )
    report("record the robot", 0.0)
    training = _recorded(model, design.motion, SEED, "designed motion")
    test = _recorded(model, random_fourier(model, SEED, n_harmonics=4), SEED + 1, "another motion")
    study = identify(
        model,
        [training.recording],
        validation=[test.recording],
        options=StudyOptions(drive=drive, method="auto"),
        progress=report,
    )
    report("write", 0.0)
    files = {
        **write_design(folder / "motion.csv", design, 1000.0),
        **write_simulation(folder / "recording.csv", training),
        "validation": write_simulation(folder / "validation.csv", test)["recording"],
        **write_study(folder, study, command=("demo", "--out", str(folder)))[0],
    }
    export, refusal = None, ""
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
        recovery=_recovered(model, study),
        causes=study.attribution or attribute(study.result),
        export=export,
        refusal=refusal,
        files=files,
        seconds=time.perf_counter() - started,
    )


def _recorded(model: RobotModel, motion: Motion, seed: int, name: str) -> SimulatedRecording:
    """Record the virtual robot on its engine.

    Without the engine, by inverse dynamics along the commanded motion.
    """
    try:
        simulated = _virtual_robot(model).record(motion, seed)
    except MissingExtraError:
        simulated = (
            VirtualRobot.typical(model, rng=SEED)
            .with_tool(GRIPPER, at="flange")
            .record(motion, rng=seed)
        )
    recording: Recording = replace(simulated.recording, source=name)
    return replace(simulated, recording=recording)


def _virtual_robot(model: RobotModel) -> VirtualRobot:
    return VirtualRobot.preset("lab", model, SEED, tool=GRIPPER, at="flange")


def _recovered(model: RobotModel, study: Study) -> Recovery | None:
    """Hold the result against the parameters of the robot that moved, along a motion of its own and
    without its sensors.
    """
    robot = _virtual_robot(model)
    bare = replace(
        robot, sensors=PERFECT_SENSORS, logger=DataLogger(rate=100.0, accelerations=True)
    )
    try:
        clean = bare.record(random_fourier(model, SEED + 1), SEED)
    except MissingExtraError:
        return None
    return compare_with_truth(study.result, replace(clean, truth=robot.truth))


def demo_text(story: Demo) -> str:
    """Return the one screen with which the demo ends."""
    result, design, held = story.study.result, story.design, story.study.validations[0]
    efficiency = (
        ""
        if design.d_efficiency is None
        else f", {share(design.d_efficiency, 0)} of the attainable information"
    )
    consistent = {
        True: "real bodies can have these parameters",
        False: "NO real bodies have these parameters",
        None: "consistency unknown",
    }
    causes, folder = story.causes, story.files["report"].parent
    costly = [int(k) for k in np.argsort(-causes.rms_cad)[:JOINTS_EXPLAINED]]
    lines = [
        (
            f"asbuilt demo: {story.model.name} with a gripper of {GRIPPER.mass:g} kg, other links,"
            " friction and sensor noise that its CAD model does not know"
        ),
        "",
        (
            f"designed    {design.motion.duration:g} s of motion in {design.solve_seconds:.0f} s:"
            f" scaled condition number {significant(design.scaled_condition_number)}{efficiency};"
            " every limit kept on a 1 kHz grid"
        ),
        *_told("recorded", "; ".join(story.training.recording.notes)),
        (
            f"identified  {result.rank} of {result.n_base} parameters by {result.method} from"
            f" {result.n_samples} samples; {consistent[result.physically_consistent]}"
        ),
        *_truth_told(story.recovery),
        (
            "predicted   another motion: torque error CAD"
            f" {share(held.metrics_cad.relative_error)}, as built"
            f" {share(held.metrics_as_built.relative_error)}"
        ),
        "",
        stacked([story.study.comparison.torque_table()]),
        f"Why CAD is off, at the {len(costly)} joints where it costs most:",
        *(
            line
            for k in costly
            for line in _told(f"  {causes.joint_names[k]}", causes.sentences[k].partition(": ")[2])
        ),
        *_told(
            "",
            f"The gripper has {GRIPPER.mass:g} kg; links that are lighter or heavier than in CAD"
            " look like less or more of it.",
        ),
        "",
        *_told("exported", story.refusal or "URDF, MJCF and C code give the identified torques"),
        *_told("files", ", ".join(path.name for path in story.files.values())),
        f"in {story.seconds:.0f} s; all in {folder}; open {story.files['report']} first",
    ]
    return "\n".join(lines) + "\n"


def _truth_told(recovery: Recovery | None) -> list[str]:
    if recovery is None:
        return []
    return [
        f"truth       {round(recovery.within(2.0) * len(recovery.names))} of {len(recovery.names)}"
        " parameters lie within 2 standard errors of it; torque without sensor noise: CAD"
        f" {share(recovery.cad_error)} off, as built {share(recovery.torque_error, 2)}"
    ]


def _told(label: str, text: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=f"{label:<12}",
        subsequent_indent=" " * 12,
        break_on_hyphens=False,
    )


def demo_document(story: Demo) -> dict[str, Any]:
    """Return what `asbuilt demo --json` prints."""
    return {
        "excite": excite_document(story.design, {}),
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
            }
        ),
        "export": None if story.export is None else story.export.as_document(),
        "files": path_texts(story.files),
        "seconds": story.seconds,
    }
