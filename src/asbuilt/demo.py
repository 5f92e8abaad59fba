"""The whole story on bundled data: design a motion, record a virtual robot, identify, validate, compare, export, write everything down."""

from __future__ import annotations

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
from asbuilt.excitation.design import Design, design_motion
from asbuilt.excitation.design_options import DesignOptions
from asbuilt.excitation.motion import Motion
from asbuilt.excitation.multistart import SearchProgress
from asbuilt.excitation.random_motion import random_point_to_point
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.simulation import InstalledRobot, SimulatedRecording
from asbuilt.experiment.virtual_robot import VirtualRobot
from asbuilt.tables import share, significant, stacked
from asbuilt.validation.attribution import Attribution, attribute
from asbuilt.validation.study import Study, StudyOptions, run_study
from asbuilt.writers.design_tables import excite_document, write_design
from asbuilt.writers.export import Export, export_result
from asbuilt.writers.recording_files import simulate_document, write_simulation
from asbuilt.writers.study_files import write_study
from asbuilt.writers.tabular import identify_document

Progress = Callable[[str, float], None]

ROBOT = "kuka-iiwa7-r800"
SEED = 7
DRIVE = "viscous,coulomb,offset"
SEARCH_SECONDS = 15.0
GRIPPER = LinkInertia.from_com(1.2, [0.01, -0.01, 0.07], np.diag([0.004, 0.0035, 0.0015]))
"""What the virtual robot carries and its description does not know."""


@dataclass(frozen=True, slots=True, eq=False)
class Demo:
    """Hold the story: the motion designed, both recordings, the study of them, what was exported, the files written."""

    model: RobotModel
    design: Design
    training: SimulatedRecording
    study: Study
    causes: Attribution
    export: Export | None
    refusal: str
    files: Mapping[str, Path]
    seconds: float


def run_demo(folder: Path, *, progress: Progress | None = None, search_seconds: float = SEARCH_SECONDS) -> Demo:
    """Run the story and write its files below `folder`."""
    report = progress or (lambda what, fraction: None)
    started = time.perf_counter()
    model, drive = bundled_robot(ROBOT), DriveSet.parse(DRIVE)

    def searched(state: SearchProgress) -> None:
        report("design a motion", min(state.seconds / search_seconds, 1.0))

    report("design a motion", 0.0)
    design = design_motion(model, drive, DesignOptions(size=5, duration=20.0, seed=SEED, time_limit=search_seconds), progress=searched)
    report("record the robot", 0.0)
    training = _recorded(model, design.motion, SEED, "designed motion")
    test = _recorded(model, random_point_to_point(model, SEED, n_poses=10), SEED + 1, "another motion")
    study = run_study(
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
        **write_study(folder, study, command=("demo", "--out", str(folder))),
    }
    export, refusal = None, ""
    try:
        export = export_result(study.result, urdf=folder / "as_built.urdf", mjcf=folder / "as_built.xml", c=folder / "as_built.c")
        files |= export.files
    except AsbuiltError as problem:
        refusal = str(problem)
    report("write", 1.0)
    return Demo(model, design, training, study, attribute(study.result), export, refusal, files, time.perf_counter() - started)


def _recorded(model: RobotModel, motion: Motion, seed: int, name: str) -> SimulatedRecording:
    """Record the virtual robot on its engine; without the engine, by inverse dynamics along the commanded motion."""
    try:
        simulated = VirtualRobot.preset("lab", model, SEED, tool=GRIPPER, at="flange").record(motion, seed)
    except MissingExtraError:
        simulated = InstalledRobot.typical(model, rng=SEED).with_tool(GRIPPER, at="flange").record(motion, rng=seed)
    recording: Recording = replace(simulated.recording, source=name)
    return replace(simulated, recording=recording)


def demo_text(story: Demo) -> str:
    """Return the one screen with which the demo ends."""
    result, design, held = story.study.result, story.design, story.study.validations[0]
    efficiency = "" if design.d_efficiency is None else f", {share(design.d_efficiency, 0)} of the attainable information"
    consistent = {True: "real bodies can have these parameters", False: "NO real bodies have these parameters", None: "consistency unknown"}
    lines = [
        f"asbuilt demo: {story.model.name} with a gripper, friction and sensor noise that its CAD model does not know",
        "",
        f"motion      {design.motion.duration:g} s designed in {design.solve_seconds:.0f} s: scaled condition number "
        f"{significant(design.scaled_condition_number)}{efficiency}; every limit kept on a 1 kHz grid",
        f"recording   {'; '.join(story.training.recording.notes)}",
        f"identified  {result.rank} of {result.n_base} parameters by {result.method} from {result.n_samples} samples; {consistent[result.physically_consistent]}",
        f"torque      error on another motion: CAD {share(held.metrics_cad.relative_error)}, as built {share(held.metrics_as_built.relative_error)}",
        "",
        stacked([story.study.comparison.torque_table()]),
        "Why CAD is off:",
        *(f"  {sentence}" for sentence in story.causes.sentences),
        "",
        f"export      {story.refusal or 'URDF, MJCF and C code give the identified torques'}",
        f"files       in {story.seconds:.0f} s; open {story.files['report']} first",
        *(f"  {kind:<11} {path}" for kind, path in story.files.items()),
    ]
    return "\n".join(lines) + "\n"


def demo_document(story: Demo) -> dict[str, Any]:
    """Return what `asbuilt demo --json` prints."""
    return {
        "excite": excite_document(story.design, {}),
        "simulate": simulate_document(story.training, {}),
        "identify": identify_document(story.study.result),
        "compare": story.study.comparison.as_document() | {"attribution": story.causes.as_document()},
        "export": None if story.export is None else story.export.as_document(),
        "files": {kind: str(path) for kind, path in story.files.items()},
        "seconds": story.seconds,
    }
