"""An identification small enough to do by hand.

Four joints, one of them sliding, names from a stranger's file; fixtures of two rooms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from asbuilt.description import (
    DHRow,
    DriveValues,
    JointLimits,
    LinkInertia,
    RobotModel,
    robot_from_dh,
)
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix, parameter_values
from asbuilt.experiment import Samples
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter
from asbuilt.findings import Finding
from asbuilt.identification import IdentificationResult, IdentifiedParameter, torque_metrics

HOSTILE = "<img src=x onerror=alert(1)>\"&'"


@dataclass(frozen=True)
class Example:
    """A design, the truth, training and held-out samples and the result fitted to the first."""

    model: RobotModel
    truth: np.ndarray
    train: Samples
    held_out: Samples
    result: IdentificationResult


def example_robot(extra_name: str = HOSTILE) -> RobotModel:
    rng = np.random.default_rng(7)
    rows = []
    for k, (a, alpha, b, kind) in enumerate(
        [
            (0.0, np.pi / 2, 0.3, "revolute"),
            (0.35, 0.0, 0.0, "revolute"),
            (0.0, 0.4, 0.1, "prismatic"),
            (0.1, -np.pi / 2, 0.2, "revolute"),
        ]
    ):
        com = rng.uniform(-0.1, 0.1, 3)
        square = rng.normal(size=(3, 3)) * 0.05
        inertia = LinkInertia.from_com(
            5.0 / (k + 1), com, np.trace(square @ square.T) * np.eye(3) - square @ square.T
        )
        name = f"axis {extra_name}" if k == 1 else f"axis_{k + 1}"
        drive = DriveValues(viscous=0.4) if k == 0 else DriveValues()
        limits = JointLimits(lower=-1.5, upper=2.0, velocity=3.0, torque=80.0)
        rows.append(
            DHRow(
                a=a,
                alpha=alpha,
                b=b,
                kind=kind,
                joint=name,
                inertia=inertia,
                drive=drive,
                limits=limits,
            )
        )
    robot = robot_from_dh(rows, name=f"arm {extra_name}", gravity=[1.0, 0.0, -9.6])
    return replace(robot, citation="Nobody, On nothing, 2001")


def example_samples(
    model: RobotModel, truth: np.ndarray, drive: DriveSet, *, source: str, seed: int, parallel: bool
) -> Samples:
    rng = np.random.default_rng(seed)
    rate, n = 100.0, model.n_joints
    t = np.arange(0.0, 40.0, 1.0 / rate)
    keep = (t % 10.0) < 8.0
    q, qd, qdd = (np.zeros((len(t), n)) for _ in range(3))
    for k in range(n):
        for w, a, phase in zip(
            rng.uniform(0.8, 4.0, 4), rng.uniform(0.1, 0.4, 4), rng.uniform(0, 6, 4), strict=True
        ):
            q[:, k] += a * np.sin(w * t + phase)
            qd[:, k] += a * w * np.cos(w * t + phase)
            qdd[:, k] -= a * w * w * np.sin(w * t + phase)
    tau = (observation_matrix(model, q, qd, qdd, drive=drive) @ truth).reshape(len(t), n)
    noise = np.zeros_like(tau)
    for i in range(1, len(t)):
        noise[i] = 0.8 * noise[i - 1] + rng.normal(size=n) * 0.05
    edges = np.flatnonzero(np.diff(np.concatenate([[0], keep[:].astype(int), [0]])))
    lengths = edges[1::2] - edges[::2]
    ends = np.cumsum(lengths)
    segments = tuple(zip((ends - lengths).tolist(), ends.tolist(), strict=True))
    return Samples(
        t[keep], q[keep], qd[keep], qdd[keep], (tau + noise)[keep],
        rate=rate, joint_names=model.joint_names, segments=segments, source=source,
        parallel=design_parallel_filter(10.0, rate, 2) if parallel else None,
        provenance=(f"simulated, seed {seed}",),
    )  # fmt: skip


def example_identification(
    *, parallel: bool = False, drive: str = "viscous,coulomb,offset"
) -> Example:
    model, terms = example_robot(), DriveSet.parse(drive)
    base = find_base_parameters(model, terms)
    rng = np.random.default_rng(3)
    described = np.nan_to_num(parameter_values(model, terms))
    truth = described * (1.0 + 0.25 * rng.normal(size=len(described)))
    truth[10 * model.n_joints :] = rng.uniform(0.2, 1.0, len(described) - 10 * model.n_joints)
    train = example_samples(model, truth, terms, source="train.csv", seed=1, parallel=parallel)
    held_out = example_samples(
        model, truth, terms, source=f"held out {HOSTILE}.csv", seed=2, parallel=parallel
    )
    W = observation_matrix(model, train.q, train.qd, train.qdd, drive=terms, columns=base.columns)
    W = train.filtered(W.reshape(len(train.t), model.n_joints, -1))
    rows = W.reshape(-1, base.n_base)
    tau = train.filtered_torque
    beta, *_ = np.linalg.lstsq(rows, tau.ravel(), rcond=None)
    error = tau - (rows @ beta).reshape(tau.shape)
    covariance = float(np.mean(error**2)) * np.linalg.inv(rows.T @ rows)
    cad = base.values(parameter_values(model, terms))
    parameters = tuple(
        IdentifiedParameter(
            int(i),
            name,
            e,
            s,
            u,
            float(c),
            float(b),
            3.0 * float(d),
            float(d),
            determined=i != base.ids[-1],
            poorly_determined=abs(b) < 3 * d,
        )
        for i, name, e, s, u, c, b, d in zip(
            base.ids,
            base.names,
            base.expressions,
            base.symbolic,
            base.units,
            cad,
            beta,
            np.sqrt(np.diag(covariance)),
            strict=True,
        )
    )
    s = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), compute_uv=False)
    test = held_out.filtered_torque
    columns = held_out.filtered(
        observation_matrix(
            model, held_out.q, held_out.qd, held_out.qdd, drive=terms, columns=base.columns
        ).reshape(len(held_out.t), model.n_joints, -1)
    )
    result = IdentificationResult(
        model=model, base=base, method="ols", sources=("train.csv",), n_samples=len(tau),
        rate=train.rate, duration=train.duration, parameters=parameters,
        covariance=9 * covariance, textbook_covariance=covariance, sigma=error.std(axis=0),
        effective_samples=len(tau) / 9, rank=base.n_base - 1, singular_values=s,
        condition_number=float(np.linalg.cond(rows)), scaled_condition_number=float(s[0] / s[-1]),
        undetermined=(f"Fo4 - {HOSTILE}",),
        train=torque_metrics(tau, tau - error, "train.csv", model.joint_names),
        validation=(torque_metrics(test, columns @ beta, held_out.source, model.joint_names),),
        cad=torque_metrics(test, columns @ np.nan_to_num(cad), held_out.source, model.joint_names),
        physically_consistent=False, consistency_margin=-0.01,
        findings=(Finding("weak_joint", "warning",
                          f"joint {model.joint_names[1]} hardly moves; lengthen the motion"),),
        provenance=train.provenance,
    )  # fmt: skip
    return Example(model, truth, train, held_out, result)


@pytest.fixture(scope="session")
def example() -> Example:
    return example_identification()


@pytest.fixture(scope="session")
def filtered_example() -> Example:
    return example_identification(parallel=True)


@pytest.fixture(scope="session")
def armature_example() -> Example:
    return example_identification(drive="armature,viscous,coulomb,offset")
