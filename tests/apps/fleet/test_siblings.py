"""Siblings as prior: closed forms, a new robot, a robot unlike its siblings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt import FleetIdentification, FleetOptions, add_logs, fleet_identify
from asbuilt.apps.fleet.identification import (
    SIBLINGS,
    SiblingPrior,
    estimate_prior,
    estimate_with_siblings,
)
from asbuilt.description import LinkInertia
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix, parameter_values
from asbuilt.errors import IdentifiabilityError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification import SquareRootInformation, consistency_margin, fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.writers import write_recording
from fleet_logs import MODEL, recording, virtual

DRIVE = DriveSet.parse("viscous,coulomb")
BASE = find_base_parameters(MODEL, DRIVE)
CHI = np.nan_to_num(parameter_values(MODEL, DRIVE), nan=0.0)
CHI[20:] = [0.6, 0.8, 0.3, 0.4]
SPREAD = 0.05
NOISE = 0.1


def member(rng: np.random.Generator) -> np.ndarray:
    """Parameters of a robot: masses in proportion, so they stay consistent."""
    chi = CHI.copy()
    chi[:10] *= 1.0 + SPREAD * rng.standard_normal()
    chi[10:20] *= 1.0 + SPREAD * rng.standard_normal()
    chi[20:] *= np.exp(2.0 * SPREAD * rng.standard_normal(4))
    return chi


def information(chi: np.ndarray, rng: np.random.Generator, seconds: float) -> SquareRootInformation:
    """Information of a log of a robot."""
    motion = random_fourier(MODEL, rng=int(rng.integers(1000)), duration=seconds).sample(50.0)
    tau = observation_matrix(MODEL, motion.q, motion.qd, motion.qdd, drive=DRIVE) @ chi
    tau = tau.reshape(-1, 2) + NOISE * rng.standard_normal((len(motion.q), 2))
    samples = Samples(
        motion.t, motion.q, motion.qd, motion.qdd, tau, 50.0, joint_names=MODEL.joint_names
    )
    return accumulate(MODEL, BASE, samples, threads=1)


@pytest.fixture(scope="module")
def prior() -> SiblingPrior:
    """The prior of a dozen robots."""
    rng = np.random.default_rng(1)
    return estimate_prior(
        MODEL, BASE, {f"R{i}": information(member(rng), rng, 20.0) for i in range(12)}
    )


def test_mean_is_physically_consistent_and_spread_is_that_of_the_robots(
    prior: SiblingPrior,
) -> None:
    assert consistency_margin(BASE, prior.mean) > 0.0
    rng = np.random.default_rng(2)
    truth = np.array([BASE.values(member(rng)) for _ in range(4000)])
    size = truth.std(axis=0)
    vary = size > 1e-9
    error = (prior.mean - truth.mean(axis=0))[vary] / size[vary]
    assert np.abs(error).max() < 1.5
    ratio = np.sqrt(np.diag(prior.covariance))[vary] / size[vary]
    assert ratio.max() < 2.5
    assert ratio.min() > 0.4


def test_estimate_is_the_posterior_mean(prior: SiblingPrior) -> None:
    rng = np.random.default_rng(3)
    new = information(member(rng), rng, 6.0)
    found, said = estimate_with_siblings("R9", new, prior)
    assert found is not None
    assert not said
    R = new.stacked(prior.weights) / np.sqrt(prior.design_effect)
    A, b = R[:-1, :-1].T @ R[:-1, :-1], R[:-1, :-1].T @ R[:-1, -1]
    inverse = np.linalg.inv(prior.covariance)
    expected = np.linalg.solve(A + inverse, b + inverse @ prior.mean)
    assert found.beta == pytest.approx(expected, rel=1e-6, abs=1e-8)
    assert found.solution.inverse_root @ found.solution.inverse_root.T == pytest.approx(
        np.linalg.inv(A + inverse), rel=1e-4, abs=1e-10
    )


def test_a_short_log_with_siblings_predicts_better_than_alone(prior: SiblingPrior) -> None:
    rng = np.random.default_rng(4)
    motion = random_fourier(MODEL, rng=5, duration=20.0).sample(50.0)
    W = observation_matrix(MODEL, motion.q, motion.qd, motion.qdd, drive=DRIVE)
    alone, helped = [], []
    for _ in range(8):
        chi = member(rng)
        new = information(chi, rng, 3.0)
        truth = BASE.values(chi)
        found, _ = estimate_with_siblings("R9", new, prior)
        assert found is not None
        wls = fit_least_squares(new, weights="joint", prior=prior.mean)
        for errors, beta in ((alone, wls.beta), (helped, found.beta)):
            errors.append(np.linalg.norm(W[:, BASE.columns] @ (beta - truth)))
    assert np.median(helped) < 0.8 * np.median(alone)


def test_a_robot_unlike_its_siblings_is_named(prior: SiblingPrior) -> None:
    rng = np.random.default_rng(6)
    chi = member(rng)
    chi[19] += 5.0
    chi[16] += 2.0
    found, said = estimate_with_siblings("odd", information(chi, rng, 10.0), prior)
    assert found is None
    assert [finding.code for finding in said] == ["unlike_siblings"]
    like = [
        estimate_with_siblings("R9", information(member(rng), rng, 10.0), prior)[0] is None
        for _ in range(30)
    ]
    assert sum(like) <= 2


@pytest.mark.study
def test_from_a_ledger(tmp_path: Path) -> None:
    here = FleetOptions(workers=0)
    for robot in range(1, 7):
        path = tmp_path / f"R{robot}" / "run_2026-03-01.csv"
        path.parent.mkdir()
        log = recording(robot, robot, 6.0)
        if robot == 6:
            tool = LinkInertia.from_com(3.0, [0.2, 0.0, 0.0], 0.01 * np.eye(3))
            motion = random_fourier(MODEL, rng=106, duration=6.0)
            log = virtual(5).with_tool(tool).record(motion, rate=100.0, rng=6).recording
            log = replace(log, torque_source="sensor")
        write_recording(path, log)
        done = add_logs(tmp_path / "ledger", "two-link", [path], robot_id=f"R{robot}", fleet=here)
        assert not done.failed
    options = FleetIdentification(prior="siblings")
    study = fleet_identify(tmp_path / "ledger", "R1", options=options)
    assert study.result.method == SIBLINGS
    odd = fleet_identify(tmp_path / "ledger", "R6", options=options)
    assert odd.result.method == "consistent"
    assert "unlike_siblings" in {finding.code for finding in odd.findings}
    add_logs(tmp_path / "two", "two-link", [path], robot_id="R6", fleet=here)
    with pytest.raises(IdentifiabilityError, match="siblings"):
        fleet_identify(tmp_path / "two", "R6", options=options)
