"""Columns of presliding friction and of elastic joints find what acts on logs by Pinocchio."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")

from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.experiment import Recording, Samples, SignalChain, prepare_samples, resolve_chain
from asbuilt.identification import expand_parameters
from asbuilt.identification.effects.families.elastic import elastic_columns as of_joint
from asbuilt.identification.effects.families.presliding import presliding_column
from asbuilt.workflow import StudyOptions, identify
from lacking import COULOMB, LACKING, NOISE, logged, trial

Columns = Callable[[Samples, np.ndarray], np.ndarray]


def elastic_columns(model: RobotModel, chi: np.ndarray, samples: Samples) -> np.ndarray:
    """Return the columns of all joints, (N, n, n)."""
    state = np.stack([samples.q, samples.qd, samples.qdd])
    joints = range(model.n_joints)
    return np.stack([of_joint(model, chi, state, samples.rate, k) for k in joints], axis=-1)


def plain(name: str) -> RobotModel:
    model = load_robot(name)
    joints = tuple(replace(joint, drive=type(joint.drive)()) for joint in model.joints)
    return replace(model, joints=joints)


def fitted(model: RobotModel, log: Recording, further: Columns) -> tuple[np.ndarray, ...]:
    """Return values and errors of further columns in a fit, and the residual of each joint.

    Further columns are those of a fit without them.
    """
    samples = prepare_samples(log, resolve_chain(SignalChain(), log))
    base = find_base_parameters(model, DriveSet.parse("viscous,coulomb,offset"))
    n, state = model.n_joints, (samples.q, samples.qd, samples.qdd)
    rows = observation_matrix(model, *state, drive=base.drive, columns=base.columns)
    parallel = samples.parallel
    assert parallel is not None
    W = parallel.apply(rows.reshape(len(samples.t), n, -1), axis=0)
    tau = parallel.apply(samples.tau, axis=0)
    sigma = np.ones((n, 1))
    for _ in range(3):
        beta = np.linalg.lstsq((W / sigma).reshape(-1, base.n_base), (tau / sigma.T).ravel())[0]
        sigma = np.sqrt(np.mean((tau - W @ beta) ** 2, axis=0))[:, None]
    extra = further(samples, expand_parameters(base, beta))
    A = np.concatenate([W, parallel.apply(extra, axis=0)], axis=2)
    scaled = (A / sigma).reshape(-1, A.shape[2])
    x = np.linalg.lstsq(scaled, (tau / sigma.T).ravel())[0]
    rms = np.sqrt(np.mean((tau - A @ x) ** 2, axis=0))
    spread = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled)))
    return x[base.n_base :], spread[base.n_base :], rms, sigma[:, 0]


@pytest.mark.study
@pytest.mark.parametrize("name", ["two-link", "ur10e"])
def test_bristles_of_the_right_length_leave_noise_and_carry_all_friction(name: str) -> None:
    model = plain(name)
    _, log = logged(model, "presliding", 0)

    def bristles(samples: Samples, _: np.ndarray) -> np.ndarray:
        columns = np.zeros((*samples.q.shape, model.n_joints))
        for k in range(model.n_joints):
            columns[:, k, k] = presliding_column(samples.q[:, k], 0.01)
        return columns

    force, _, rms, without = fitted(model, log, bristles)
    assert np.all(without > 4.0 * NOISE)
    assert np.all(rms < 1.1 * NOISE)
    np.testing.assert_allclose(force, COULOMB, rtol=0.05)


@pytest.mark.study
def test_compliances_are_those_of_the_joints() -> None:
    model = plain("ur10e")
    robot, log = logged(model, "elastic", 0)
    found, error, rms, without = fitted(model, log, lambda s, chi: elastic_columns(model, chi, s))
    true = np.array([1.0 / robot.stiffness[k] for k in range(model.n_joints)])
    # Joint 6 carries so little that its compliance is not determined.
    np.testing.assert_allclose(found[:5], true[:5], rtol=0.15)
    assert np.all(error[:3] < 0.1 * true[:3])
    assert np.all(rms < 1.1 * NOISE)
    assert np.all(without[:3] > 2.0 * NOISE)


@pytest.mark.study
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_intervals_hold_the_truth_where_nothing_is_lacking(engine: str) -> None:
    model = plain("two-link")
    held = []
    for seed in range(6):
        robot, log = logged(model, "nothing", seed, engine)  # type: ignore[arg-type]
        study = identify(model, log, options=StudyOptions(method="wls"))
        held.append(trial(robot, study, LACKING["nothing"]).held)
    assert np.mean(held) > 0.85
