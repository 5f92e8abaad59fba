"""Move a virtual iiwa 7 along a random Fourier series and along a spline, and record it twice.

As designed and as installed.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from asbuilt import load_robot, simulate_recording
from asbuilt.excitation.limits import check_motion
from asbuilt.excitation.motions.motion_csv import read_motion
from asbuilt.excitation.motions.random_motion import random_fourier, random_point_to_point
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.writers.motion_files import write_motion

model = load_robot("kuka-iiwa7-r800")

excitation = random_fourier(model, rng=1, duration=20.0, n_harmonics=5)
validation = random_point_to_point(model, rng=2, n_poses=8)
for motion in (excitation, validation):
    report = check_motion(model, motion)
    report.raise_if_violated()
    print(f"{motion.parametrisation} motion, {motion.duration:.1f} s, nearest limits:")
    print(report)

with tempfile.TemporaryDirectory() as folder:
    path = write_motion(Path(folder) / "excitation.csv", excitation, model.joint_names)
    back = read_motion(path, model)
    print(
        f"\nthe motion file has {path.stat().st_size / 1e6:.1f} MB and reads back to"
        f" {np.abs(back.end - excitation.end).max():.0e} rad"
    )

designed = simulate_recording(model, excitation)
installed = VirtualRobot.typical(model, rng=3).record(excitation, rng=4)

print(f"\n{installed.recording.notes[0]}")
print("joint   torque RMS [N m]   what the description misses [N m]")
for j, name in enumerate(model.joint_names):
    torque, missing = (
        installed.recording.tau[:, j],
        installed.recording.tau[:, j] - designed.tau[:, j],
    )
    print(f"{name:5s} {np.sqrt(np.mean(torque**2)):18.2f} {np.sqrt(np.mean(missing**2)):19.2f}")

tool = installed.model.links[-1].parts[-1][1]
print(
    f"\ntruth kept beside the recording: {len(installed.names)} parameters, among them a gripper of"
    f" {tool.mass:.2f} kg"
)
