"""Time of one sample called from Python, 7 joints, in multiples of `pinocchio.rnea`, same run."""

from __future__ import annotations

import timeit
from collections.abc import Callable

import numpy as np
import pinocchio as pin

from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.newton_euler import gravity_torque, inverse_dynamics, mass_matrix
from asbuilt.dynamics.torque_model import TorqueModel
from peer import pinocchio_model

ROBOT = "kuka-iiwa7-r800"
USUAL = "armature,viscous,coulomb,offset"


def measure() -> dict[str, float | str]:
    """Return microseconds per call and multiples of the time of Pinocchio's."""
    model, rng = load_robot(ROBOT), np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, model.n_joints))
    calls: dict[str, Callable[[], object]] = {
        "inverse_dynamics": lambda: inverse_dynamics(model, q, qd, qdd),
        "gravity_torque": lambda: gravity_torque(model, q),
        "mass_matrix": lambda: mass_matrix(model, q),
    }
    for name, keys in (("usual_drive", USUAL), ("rich_drive", f"{USUAL},stribeck,load_friction")):
        drive = DriveSet.parse(keys)
        values = rng.normal(size=model.n_joints * drive.columns_per_joint)
        torque = TorqueModel(model, drive, values)
        calls[f"torque_{name}"] = lambda torque=torque: torque(q, qd, qdd)
    peer = pinocchio_model(model)
    data = peer.createData()
    calls["pinocchio_rnea"] = lambda: pin.rnea(peer, data, q, qd, qdd)
    times = dict.fromkeys(calls, np.inf)
    for _ in range(40):
        for name, call in calls.items():
            times[name] = min(times[name], 1e3 * min(timeit.repeat(call, number=1000, repeat=1)))
    own = {name: time for name, time in times.items() if name != "pinocchio_rnea"}
    return {f"{name}_us_per_sample": time for name, time in times.items()} | {
        f"multiple_of_pinocchio_{name}": time / times["pinocchio_rnea"]
        for name, time in own.items()
    }
