"""Design a motion within the limits and away from a wall, and compare it with a random one."""

import tempfile
from pathlib import Path

import numpy as np

import asbuilt

CELL = """
skeleton = 0.06
floor = 0.0
[[obstacles]]
name = "wall"
size = [0.1, 3, 3]
position = [0.7, 0, 1]
"""

model = asbuilt.load_robot("kuka-iiwa7-r800")
with tempfile.TemporaryDirectory() as folder:
    cell = Path(folder) / "cell.toml"
    cell.write_text(CELL)
    options = asbuilt.DesignOptions(size=5, starts=2, collision=str(cell))
    design = asbuilt.design_motion(model, options)
print(design)
assert design.collision_distance >= 0.0

drive = asbuilt.DriveSet.parse("viscous,coulomb,offset")
base = asbuilt.find_base_parameters(model, drive)


def log_det(motion):
    """Return the log-determinant of the mean information of a motion at unit torque noise."""
    states = motion.sample(100.0)
    W = asbuilt.observation_matrix(
        model, states.q, states.qd, states.qdd, drive=drive, columns=base.columns
    )
    return np.linalg.slogdet(W.T @ W / len(states.t))[1]


gain = (log_det(design.motion) - log_det(asbuilt.random_fourier(model, rng=0))) / base.n_base
print(f"\none second of it is worth {np.exp(gain):.1f} s of a random motion")
assert gain > 0.0
