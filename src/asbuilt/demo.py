"""The whole story on bundled data: move, record a virtual installed robot, identify, validate, compare, write everything down."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.description.catalogue import bundled_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.fourier import FourierMotion
from asbuilt.excitation.limits import LimitReport, check_motion
from asbuilt.excitation.motion_csv import write_motion
from asbuilt.excitation.random_motion import random_fourier, random_point_to_point
from asbuilt.experiment.simulation import InstalledRobot, SimulatedRecording
from asbuilt.validation.study import Study, StudyOptions, run_study
from asbuilt.writers.recording_files import simulate_document, write_simulation
from asbuilt.writers.study_files import study_text, write_study
from asbuilt.writers.tabular import identify_document

Progress = Callable[[str, float], None]

ROBOT = "kuka-iiwa7-r800"
SEED = 7
DURATION = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Demo:
    """Hold the story: the robot by design, the motion, both recordings, the study of them and the files written."""

    model: RobotModel
    motion: FourierMotion
    limits: LimitReport
    training: SimulatedRecording
    test: SimulatedRecording
    study: Study
    files: Mapping[str, Path]
    seconds: float


def run_demo(folder: Path, *, progress: Progress | None = None) -> Demo:
    """Run the story and write its files below `folder`."""
    report = progress or (lambda what, fraction: None)
    started = time.perf_counter()
    model = bundled_robot(ROBOT)
    rng = np.random.default_rng(SEED)
    report("move", 0.0)
    motion = random_fourier(model, rng, duration=DURATION)
    limits = check_motion(model, motion)
    report("record", 0.0)
    robot = InstalledRobot.typical(model, rng=SEED)
    training = robot.record(motion, rng=SEED)
    test = robot.record(random_point_to_point(model, rng, n_poses=8), rng=SEED + 1)
    study = run_study(
        model,
        [training.recording],
        validation=[test.recording],
        options=StudyOptions(drive=DriveSet.parse("armature,viscous,coulomb,offset")),
        progress=report,
    )
    report("write", 0.0)
    files = {
        "motion": write_motion(folder / "motion.csv", motion, model.joint_names),
        **write_simulation(folder / "recording.csv", training),
        "validation": write_simulation(folder / "validation.csv", test)["recording"],
        **write_study(folder, study, command=("demo", "--out", str(folder))),
    }
    report("write", 1.0)
    return Demo(model, motion, limits, training, test, study, files, time.perf_counter() - started)


def demo_text(story: Demo) -> str:
    """Return the one screen with which the demo ends."""
    files = "\n".join(f"  {kind:<11} {path}" for kind, path in story.files.items())
    return f"{study_text(story.study)}\n\n{'; '.join(story.training.recording.notes)}\n\nwritten in {story.seconds:.1f} s:\n{files}\n"


def demo_document(story: Demo) -> dict[str, Any]:
    """Return what `asbuilt demo --json` prints."""
    files = {kind: str(path) for kind, path in story.files.items()}
    return {
        "excite": {
            "robot": story.model.name,
            "parametrisation": story.motion.parametrisation,
            "duration": story.motion.duration,
            "n_harmonics": story.motion.n_harmonics,
            "worst_margin": story.limits.worst_margin,
        },
        "simulate": simulate_document(story.training, {}),
        "identify": identify_document(story.study.result),
        "compare": story.study.comparison.as_document(),
        "files": files,
        "seconds": story.seconds,
    }
