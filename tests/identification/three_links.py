"""A robot of three links whose truth is known, and recordings of it."""

from __future__ import annotations

import numpy as np

from asbuilt.description import DHRow, LinkInertia, robot_from_dh
from asbuilt.dynamics import DriveSet, observation_matrix, parameter_values
from asbuilt.experiment import Samples
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter
from asbuilt.identification import Rows

DRIVE = DriveSet.parse("viscous,coulomb,offset")
RATE = 50.0
DRIVES = np.array([0.8, 1.5, -0.2, 0.6, 1.1, 0.1, 0.3, 0.5, 0.05])


def arm(scale=1.0):
    """Three links that bodies of uniform density could have."""
    rng = np.random.default_rng(3)
    rows = []
    for a, alpha, b, mass in [
        (0.0, np.pi / 2, 0.3, 6.0),
        (0.35, 0.0, 0.0, 4.0),
        (0.25, -np.pi / 2, 0.1, 2.0),
    ]:
        half = rng.uniform(0.05, 0.2, 3)
        inertia = LinkInertia.from_com(
            scale * mass,
            rng.uniform(-0.1, 0.1, 3),
            scale * mass / 3 * (np.sum(half**2) * np.eye(3) - np.diag(half**2)),
        )
        rows.append(DHRow(a=a, alpha=alpha, b=b, inertia=inertia))
    return robot_from_dh(rows, name="three links", gravity=[0.0, 0.0, -9.81])


def truth(base, model, scale=1.0):
    """Heavier than designed, each link as a whole, with friction."""
    chi = parameter_values(model, DRIVE)
    chi[:30] = (chi[:30].reshape(3, 10) * np.array([1.1, 1.3, 0.9])[:, None]).ravel()
    chi[30:] = scale * DRIVES
    return base.values(chi)


def recording(
    model,
    base,
    beta,
    *,
    noise=0.0,
    seconds=24.0,
    seed=0,
    still=(),
    source="recording",
    parallel=True,
):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / RATE)
    q, qd, qdd = (np.zeros((len(t), 3)) for _ in range(3))
    for k in range(3):
        q[:, k] = rng.uniform(-0.5, 0.5)
        if k in still:
            continue
        for _ in range(5):
            a, w, phase = rng.uniform(0.1, 0.4), rng.uniform(0.5, 5.0), rng.uniform(0, 6)
            q[:, k] += a * np.sin(w * t + phase)
            qd[:, k] += a * w * np.cos(w * t + phase)
            qdd[:, k] -= a * w * w * np.sin(w * t + phase)
    tau = (observation_matrix(model, q, qd, qdd, drive=DRIVE, columns=base.columns) @ beta).reshape(
        q.shape
    )
    tau = tau + noise * rng.normal(size=tau.shape) * [1.0, 2.0, 0.5]
    names = model.joint_names
    return Samples(
        t,
        q,
        qd,
        qdd,
        tau,
        rate=RATE,
        joint_names=names,
        source=source,
        parallel=design_parallel_filter(6.0, RATE, 2) if parallel else None,
    )


def full_rows(model, base, samples):
    """Rows of every joint as dense matrices."""
    rows = Rows(model, base, [samples])
    blocks = list(rows)
    joints = []
    for k, support in enumerate(rows.support):
        columns = np.hstack([block.rows[k] for block in blocks])
        W = np.zeros((columns.shape[1], base.n_base))
        W[:, support] = columns[:-1].T
        joints.append((W, columns[-1]))
    return joints
