"""Identify a virtual UR10e and write it as URDF, MJCF, TOML and C, which a compiler checks."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import asbuilt

model = asbuilt.load_robot("ur10e")
motion = asbuilt.random_fourier(model, rng=1, duration=20.0)
recording = asbuilt.VirtualRobot.typical(model, rng=3).record(motion, rng=4).recording
options = asbuilt.StudyOptions(method="consistent", holdout="blocks:2s:3")
result = asbuilt.identify(model, recording, options=options).result
assert result.physically_consistent

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    files = {kind: folder / f"ur10e.{kind}" for kind in ("urdf", "toml", "c")}
    exported = asbuilt.export_result(result, mjcf=folder / "ur10e.xml", **files)
    print(exported.as_text().replace(f"{folder}/", ""))

    q, qd, qdd = np.random.default_rng(0).normal(size=(3, 6))
    back = asbuilt.load_robot(files["toml"])
    rigid = asbuilt.inverse_dynamics(back, q, qd, qdd)
    print("torque of the links alone [N m]:", np.round(rigid, 2))

    if shutil.which("gcc"):
        program = folder / "self_test"
        command = ["gcc", "-std=c99", "-DUR10E_SELF_TEST", files["c"], "-o", program, "-lm"]
        subprocess.run(command, check=True)
        done = subprocess.run([program], check=True, capture_output=True, text=True)
        print("the C code, compiled, against asbuilt:", done.stdout.strip())
