"""Move a virtual iiwa 7, as designed and as installed, and see what the description misses."""

import tempfile
from pathlib import Path

import numpy as np

import asbuilt

model = asbuilt.load_robot("kuka-iiwa7-r800")
motion = asbuilt.random_fourier(model, rng=1, duration=20.0, n_harmonics=5)

designed = asbuilt.simulate_recording(model, motion)
installed = asbuilt.VirtualRobot.typical(model, rng=3).record(motion, rng=4)
missing = installed.recording.tau - designed.tau
print("joint   torque RMS [N m]   not in the description [N m]")
for name, torque, rest in zip(model.joint_names, designed.tau.T, missing.T, strict=True):
    print(f"{name:5} {np.sqrt(np.mean(torque**2)):18.2f} {np.sqrt(np.mean(rest**2)):18.2f}")
assert np.linalg.norm(missing) > 0.02 * np.linalg.norm(designed.tau)

with tempfile.TemporaryDirectory() as folder:
    path = asbuilt.write_recording(Path(folder) / "log.csv", installed.recording)
    back = asbuilt.read_recording(path, model=model)
assert np.abs(back.tau - installed.recording.tau).max() < 1e-6
print(f"\n{back}")
