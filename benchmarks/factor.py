"""Time from samples to solved parameters, 43 base + 21 drive columns, against Pinocchio from Python
and `numpy.linalg.lstsq`.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.linalg import qr

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.torque import drive_torque
from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.dynamics.newton_euler import inverse_dynamics
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.bodies.cad_prior import design_values
from asbuilt.identification.bodies.consistency import consistency_margin
from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate
from peer import best, pinocchio_model

ROBOT = "kuka-iiwa7-r800"
DRIVE = "viscous,coulomb,offset"
N_SAMPLES = 100_000
N_PEER = 10_000
RATE = 1000.0


def recorded(
    model: RobotModel, drive: DriveSet, t: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Return q, qd, qdd and noisy tau of a periodic motion at the times t, the same motion for all
    parts of a recording.
    """
    n, omega = model.n_joints, 2 * np.pi * 0.1
    shape = np.random.default_rng(7)
    q, qd, qdd = (np.zeros((t.size, n)) for _ in range(3))
    for k in range(1, 6):
        a, b = shape.normal(scale=0.5 / k, size=(2, n))
        c, s = np.cos(k * omega * t)[:, None], np.sin(k * omega * t)[:, None]
        q += a * s + b * c
        qd += k * omega * (a * c - b * s)
        qdd -= (k * omega) ** 2 * (a * s + b * c)
    tau = inverse_dynamics(model, q, qd, qdd) + drive_torque(
        drive, np.tile([1.0, 2.0, 0.1], n), q, qd, qdd
    )
    return q, qd, qdd, tau + rng.normal(scale=0.1, size=q.shape)


def peer_solve(
    model: RobotModel,
    chosen: np.ndarray,
    peer: pin.Model,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    tau: np.ndarray,
) -> np.ndarray:
    """Stack Pinocchio's regressor sample by sample with friction columns and solve by LAPACK's
    singular values.
    """
    n, data = model.n_joints, peer.createData()
    w = np.zeros((len(q), n, len(chosen) + 3 * n))
    for i in range(len(q)):
        w[i, :, : len(chosen)] = pin.computeJointTorqueRegressor(peer, data, q[i], qd[i], qdd[i])[
            :, chosen
        ]
    for k in range(n):
        w[:, k, len(chosen) + 3 * k : len(chosen) + 3 * k + 3] = np.column_stack(
            [qd[:, k], np.sign(qd[:, k]), np.ones(len(q))]
        )
    with use_one_blas_thread():
        return np.linalg.lstsq(w.reshape(len(q) * n, -1), tau.ravel(), rcond=None)[0]


def independent_columns(peer: pin.Model, n_base: int, n: int) -> np.ndarray:
    """Return `n_base` independent columns of Pinocchio's regressor."""
    rng, data = np.random.default_rng(0), peer.createData()
    stack = np.vstack(
        [pin.computeJointTorqueRegressor(peer, data, *rng.normal(size=(3, n))) for _ in range(60)]
    )
    return np.sort(qr(stack, mode="r", pivoting=True)[1][:n_base])


def measure() -> dict[str, float | str]:
    """Return microseconds per sample, milliseconds and ratios to the peer."""
    model, drive = load_robot(ROBOT), DriveSet.parse(DRIVE)
    base = find_base_parameters(model, drive)
    t = np.arange(N_SAMPLES) / RATE
    q, qd, qdd, tau = recorded(model, drive, t, np.random.default_rng(0))
    samples = Samples(t, q, qd, qdd, tau, rate=RATE, joint_names=model.joint_names)
    parallel = Samples(
        t,
        q,
        qd,
        qdd,
        tau,
        rate=RATE,
        joint_names=model.joint_names,
        parallel=design_parallel_filter(10.0, RATE, 20),
    )
    peer = pinocchio_model(model)
    chosen = independent_columns(peer, base.n_base - 3 * model.n_joints, model.n_joints)
    part = tuple(array[:N_PEER] for array in (q, qd, qdd, tau))

    ours = best(lambda: accumulate(model, base, samples, threads=1), N_SAMPLES, 5)
    theirs = best(lambda: peer_solve(model, chosen, peer, *part), N_PEER, 2)
    information = accumulate(model, base, samples)
    estimate = fit_least_squares(information, weights="joint", prior=design_values(model, base))
    return {
        "regressor_and_factor_us_per_sample": ours,
        "regressor_and_factor_two_threads_us_per_sample": best(
            lambda: accumulate(model, base, samples, threads=2), N_SAMPLES, 5
        ),
        "regressor_filter_and_factor_us_per_sample": best(
            lambda: accumulate(model, base, parallel, threads=1), N_SAMPLES, 5
        ),
        "pinocchio_from_python_and_lstsq_us_per_sample": theirs,
        "ratio_regressor_and_factor_to_pinocchio_and_lstsq": theirs / ours,
        "weighted_fit_ms": (
            best(lambda: fit_least_squares(information, weights="joint"), 1, 5) / 1e3
        ),
        "consistency_ms": best(lambda: consistency_margin(base, estimate.beta), 1, 5) / 1e3,
    }
