"""Design motions for four robots, compare them with random ones and an upper bound, avoid a cell."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from asbuilt import load_robot
from asbuilt.excitation.design.design import design_motion
from asbuilt.excitation.design.options import DesignOptions
from asbuilt.excitation.design.static_poses import design_static_poses
from asbuilt.excitation.information.information import Information, mean_information
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.writers.motion_files import write_motion

print(
    "robot             parameters  log det  efficiency  of its harmonics  condition  scaled  random"
    " is worth"
)
for name in ("kuka-iiwa7-r800", "ur10e", "franka-panda", "two-link"):
    model = load_robot(name)
    design = design_motion(
        model, DesignOptions(duration=20.0, size=5, starts=4, time_limit=4.0)
    )
    states = random_fourier(model, rng=0).sample(100)
    random = mean_information(Information.of(model, design.base), states.q, states.qd, states.qdd)
    worth = np.exp(
        (np.linalg.slogdet(random)[1] - np.linalg.slogdet(design.mean_information)[1])
        / design.base.n_base
    )
    print(
        f"{name:18s}{design.base.n_base:10d} {design.log_det:8.1f} {design.d_efficiency:10.1%}"
        f" {design.family_efficiency:16.1%} {design.condition_number:11.1f}"
        f" {design.scaled_condition_number:7.2f} {worth:15.1%}"
    )

iiwa = load_robot("kuka-iiwa7-r800")
with tempfile.TemporaryDirectory() as folder:
    cell = Path(folder) / "cell.toml"
    cell.write_text(
        'skeleton = 0.06\nfloor = 0.0\n[[obstacles]]\nname = "wall"\nsize = [0.1, 3, 3]\nposition ='
        " [0.7, 0, 1]\n"
    )
    careful = design_motion(
        iiwa, DesignOptions(size=5, starts=2, time_limit=8.0, collision=str(cell))
    )
    path = write_motion(Path(folder) / "motion.csv", careful.motion, iiwa.joint_names)
    print(
        f"\nin a cell: log det {careful.log_det:.1f}, nearest approach"
        f" {1000 * (careful.collision_distance or 0):.0f} mm, {path.stat().st_size / 1e6:.1f} MB"
    )
print(careful.limits)

standing = design_static_poses(iiwa, 12)
print(
    f"\n{len(standing.poses)} poses determine the {standing.n_parameters} gravity parameters, condition"
    f" number {standing.condition_number:.2f}"
)
