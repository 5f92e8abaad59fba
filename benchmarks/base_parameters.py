"""Time to find the base parameters, structure and numeric check together, for arms of 7 and 30
joints.
"""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

from asbuilt.description.formats.dh import DHRow, robot_from_dh
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import _find_cached, find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.kernels.recursion import build_layout
from asbuilt.dynamics.regressor import _make_plan

DRIVE = "armature,viscous,coulomb,offset"
REMEMBERING = (_find_cached, _make_plan, build_layout)
"""Functions whose earlier answers would be timed instead of the work."""
COLD = (
    "import time; from asbuilt import load_robot, find_base_parameters; m ="
    " load_robot('kuka-iiwa7-r800'); import asbuilt.dynamics.base.base_parameters; t ="
    " time.perf_counter(); find_base_parameters(m); print(time.perf_counter() - t)"
)


def long_arm(n_joints: int) -> RobotModel:
    """Return an arm of alternating axes with lengths in every row."""
    inertia = LinkInertia.from_com(1.0, [0.1, 0.02, 0.03], np.diag([0.02, 0.03, 0.04]))
    rows = [
        DHRow(a=0.1, b=0.2, alpha=(-1) ** k * np.pi / 2, inertia=inertia) for k in range(n_joints)
    ]
    return robot_from_dh(rows, name=f"arm of {n_joints} joints")


def milliseconds(model: RobotModel, drive: DriveSet) -> float:
    """Return the shortest of five runs [ms], each without what was remembered of earlier ones."""
    times = []
    for _ in range(5):
        for function in REMEMBERING:
            function.cache_clear()
        start = time.perf_counter()
        find_base_parameters(model, drive)
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def measure() -> dict[str, float | str]:
    """Return milliseconds."""
    cold = subprocess.run([sys.executable, "-c", COLD], capture_output=True, text=True, check=True)
    iiwa, long = load_robot("kuka-iiwa7-r800"), long_arm(30)
    return {
        "first_call_7_joints_ms": 1e3 * float(cold.stdout),
        "7_joints_ms": milliseconds(iiwa, DriveSet()),
        "7_joints_with_drives_ms": milliseconds(iiwa, DriveSet.parse(DRIVE)),
        "30_joints_ms": milliseconds(long, DriveSet()),
        "30_joints_with_drives_ms": milliseconds(long, DriveSet.parse(DRIVE)),
    }
