"""Time of the regressor and the equations of motion per sample, 7 joints, one core, against
Pinocchio called from Python.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from asbuilt.description.load import load_robot
from asbuilt.dynamics import newton_euler
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.regressor import RegressorPlan
from peer import best, pinocchio_model

ROBOT = "kuka-iiwa7-r800"
BLOCK = 2048
LONG = 32768


def measure() -> dict[str, float | str]:
    """Return microseconds per sample and ratios to Pinocchio."""
    model, rng = load_robot(ROBOT), np.random.default_rng(0)
    drive = DriveSet.parse("viscous,coulomb,offset")
    chosen = find_base_parameters(model, drive).columns
    motion = tuple(rng.uniform(-2.0, 2.0, (LONG, model.n_joints)) for _ in range(3))
    block = tuple(array[:BLOCK] for array in motion)
    q, qd, qdd = motion

    peer, thousand = (
        pinocchio_model(model),
        list(zip(*(array[:1000] for array in motion), strict=True)),
    )
    data = peer.createData()
    pinocchio_regressor = best(
        lambda: [pin.computeJointTorqueRegressor(peer, data, *sample) for sample in thousand],
        1000,
        5,
    )
    pinocchio_rnea = best(lambda: [pin.rnea(peer, data, *sample) for sample in thousand], 1000, 5)

    standard, wanted = RegressorPlan.of(model), RegressorPlan.of(model, drive, chosen)
    reused, reused_wanted = standard.buffer(BLOCK), wanted.buffer(BLOCK)
    rows = best(lambda: standard.evaluate(*block, reused), BLOCK, 300)
    tau = newton_euler.inverse_dynamics(model, q, qd, qdd, threads=1)
    inverse = best(lambda: newton_euler.inverse_dynamics(model, q, qd, qdd, threads=1), LONG, 10)
    return {
        "regressor_us_per_sample": rows,
        "regressor_43_base_21_drive_us_per_sample": best(
            lambda: wanted.evaluate(*block, reused_wanted), BLOCK, 300
        ),
        "observation_matrix_us_per_sample": best(lambda: standard.stack(*motion), LONG, 5),
        "observation_matrix_43_base_21_drive_us_per_sample": best(
            lambda: wanted.stack(*motion), LONG, 5
        ),
        "inverse_dynamics_us_per_sample": inverse,
        "inverse_dynamics_all_cores_us_per_sample": best(
            lambda: newton_euler.inverse_dynamics(model, q, qd, qdd), LONG, 10
        ),
        "mass_matrix_us_per_sample": best(
            lambda: newton_euler.mass_matrix(model, q[:8000]), 8000, 10
        ),
        "coriolis_matrix_us_per_sample": best(
            lambda: newton_euler.coriolis_matrix(model, q[:1024], qd[:1024]), 1024, 5
        ),
        "forward_dynamics_us_per_sample": best(
            lambda: newton_euler.forward_dynamics(model, q[:8000], qd[:8000], tau[:8000]), 8000, 5
        ),
        "one_sample_inverse_dynamics_us_per_sample": best(
            lambda: newton_euler.inverse_dynamics(model, q[0], qd[0], qdd[0]), 1, 500
        ),
        "pinocchio_regressor_us_per_sample": pinocchio_regressor,
        "pinocchio_inverse_dynamics_us_per_sample": pinocchio_rnea,
        "ratio_pinocchio_regressor": pinocchio_regressor / rows,
        "ratio_pinocchio_inverse_dynamics": pinocchio_rnea / inverse,
    }
