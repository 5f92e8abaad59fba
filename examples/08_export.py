"""Identify a virtual UR10e and hand the model to other software.

URDF, MJCF and C code that a compiler checks.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from asbuilt import load_robot
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.workflow.study import StudyOptions, identify
from asbuilt.writers.models.export import export_result

model = load_robot("ur10e")
recording = (
    VirtualRobot.typical(model, rng=3)
    .record(random_fourier(model, rng=1, duration=20.0), rng=4)
    .recording
)
options = StudyOptions(
    method="consistent",
    drive=DriveSet.parse("armature,viscous,coulomb,offset"),
    holdout="blocks:2s:3",
)
result = identify(model, [recording], options=options).result
print(
    f"torque error held out: CAD {100 * result.cad.relative_error:.1f} %, as built"
    f" {100 * result.validation[0].relative_error:.1f} %\n"
)

with tempfile.TemporaryDirectory() as folder:
    place = Path(folder)
    exported = export_result(
        result,
        urdf=place / "ur10e.urdf",
        mjcf=place / "ur10e.xml",
        c=place / "ur10e.c",
        toml=place / "ur10e.toml",
    )
    print(exported.as_text().replace(f"{place}/", ""))
    if shutil.which("gcc"):
        program = place / "self_test"
        subprocess.run(
            [
                "gcc",
                "-std=c99",
                "-DUR10E_SELF_TEST",
                str(exported.files["c"]),
                "-o",
                str(program),
                "-lm",
            ],
            check=True,
        )
        print(
            "\nthe C code, compiled, against asbuilt:",
            subprocess.run([program], check=True, capture_output=True, text=True).stdout.strip(),
        )
