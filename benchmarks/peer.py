"""What the benchmarks measure with.

The shortest of several runs, and the same robot in Pinocchio called from Python.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from asbuilt.description.model import RobotModel


def best(work: Callable[[], object], n_samples: int, repeats: int) -> float:
    """Return the shortest of several runs [microseconds per sample].

    The first call, which compiles, does not count.
    """
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times) / n_samples * 1e6


def pinocchio_model(model: RobotModel) -> pin.Model:
    """Build the same chain of revolute joints in Pinocchio."""
    built, after = pin.Model(), pin.SE3.Identity()
    for i, joint in enumerate(model.joints):
        number = built.addJoint(
            i, pin.JointModelRZ(), after * pin.SE3(np.array(joint.before)), joint.name
        )
        after = pin.SE3(np.array(joint.after))
        xx, xy, xz, yy, yz, zz, mx, my, mz, m = model.links[i].inertia.parameters
        built.appendBodyToJoint(
            number,
            pin.Inertia.FromDynamicParameters(np.array([m, mx, my, mz, xx, xy, yy, xz, yz, zz])),
            after,
        )
    return built
