"""Swapped torques are found without CAD values."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import RobotModel, bundled_robot, load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, VirtualRobot, check_recording, read_recordings
from asbuilt.experiment.quality import torque_fit
from asbuilt.experiment.quality.torque_fit import (
    TorqueFit,
    find_best_assignment,
    find_swapped_torques,
    friction_bases,
)
from studied_cases import first_of


def recorded(model: RobotModel, seed: int = 1, duration: float = 12.0) -> Recording:
    return (
        VirtualRobot.typical(model, rng=seed)
        .record(random_fourier(model, seed, duration=duration), rate=100.0, rng=seed)
        .recording
    )


def swapped(recording: Recording, one: int, other: int) -> Recording:
    order = np.arange(recording.tau.shape[1])
    order[[one, other]] = other, one
    return replace(recording, tau=recording.tau[:, order])


def fit_of(model: RobotModel, recording: Recording) -> TorqueFit:
    q = recording.q
    qd, order = np.gradient(q, recording.t, axis=0), tuple(range(model.n_joints))
    qdd, bases = (
        np.gradient(qd, recording.t, axis=0),
        friction_bases(qd, np.zeros((qd.shape[1], len(qd), 0))),
    )
    return TorqueFit(model, q, qd, qdd, recording.tau, bases, order, order)


@pytest.mark.parametrize("robot", ["scara", "ur10e", "puma-560"])
def test_every_swap_is_found_whatever_cad_says(robot: str) -> None:
    """The masses of the description are a thousandth of the robot's; only its geometry is used."""
    model = bundled_robot(robot)
    recording = recorded(model)
    light = model.with_parameters(1e-3 * model.parameters)
    assert find_swapped_torques(fit_of(light, recording)) is None
    for pair in combinations(range(model.n_joints), 2):
        found = find_swapped_torques(fit_of(light, swapped(recording, *pair)))
        assert found is not None
        assert found.joints == pair
        assert found.swapped < 0.2 * found.as_logged


@pytest.mark.parametrize("robot", ["ur10e", "puma-560"])
def test_suspects_hold_the_swap_that_every_pair_finds(
    robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large robots are asked by suspects alone; a small one, asked so, gives the same answer."""
    model = bundled_robot(robot)
    recording = recorded(model)
    every = [
        find_swapped_torques(fit_of(model, swapped(recording, *pair)))
        for pair in combinations(range(model.n_joints), 2)
    ]
    monkeypatch.setattr(torque_fit, "EVERY_PAIR", 0)
    monkeypatch.setattr(torque_fit, "MOST_SUSPECTS", 3)
    assert find_swapped_torques(fit_of(model, recording)) is None
    for pair, expected in zip(combinations(range(model.n_joints), 2), every, strict=True):
        mixed = fit_of(model, swapped(recording, *pair))
        assert find_swapped_torques(mixed) == expected
        found = find_best_assignment(mixed)
        moved = [k for k, j in enumerate(found.torque_of) if j != k]
        assert moved in ([], list(pair))


def test_unexplained_shares_are_those_of_a_dense_fit() -> None:
    """numpy's least squares on all rows, torques scaled to unit variance, leaves the same."""
    model = bundled_robot("scara")
    fit = fit_of(model, swapped(recorded(model), 1, 3))
    found = find_swapped_torques(fit)
    assert found is not None
    base = find_base_parameters(model, DriveSet.parse("viscous,offset"))
    samples, n = fit.tau.shape
    dry = np.zeros((samples, n, n))
    dry[:, range(n), range(n)] = np.tanh(fit.qd / 0.02)
    rigid = observation_matrix(
        model, fit.q, fit.qd, fit.qdd, drive=base.drive, columns=base.columns
    ).reshape(samples, n, -1)
    for order, expected in (([0, 1, 2, 3], found.as_logged), ([0, 3, 2, 1], found.swapped)):
        tau = fit.tau[:, order]
        spread = tau.std(axis=0)
        rows = (np.concatenate([rigid, dry], axis=2) / spread[:, None]).reshape(samples * n, -1)
        target = ((tau - tau.mean(axis=0)) / spread).ravel()
        left = target - rows @ np.linalg.lstsq(rows, target, rcond=None)[0]
        assert np.mean(left.reshape(samples, n)[:, [1, 3]] ** 2) == pytest.approx(
            expected, rel=1e-5
        )


def test_too_few_samples_decide_nothing() -> None:
    model = bundled_robot("ur10e")
    fit = fit_of(model, swapped(recorded(model), 4, 5))
    assert (
        find_swapped_torques(
            replace(fit, q=fit.q[:25], qd=fit.qd[:25], qdd=fit.qdd[:25], tau=fit.tau[:25])
        )
        is None
    )


@pytest.mark.parametrize(
    "log", first_of(1, ["ur-20_02_10-30sec_12harm.csv", "ur-20_01_17-ptp_10_points.csv"])
)
def test_wrists_of_a_real_arm(shared: Path, tmp_path: Path, log: str) -> None:
    sheet = tmp_path / "sheet.toml"
    sheet.write_text(
        'header = false\ntorque_source = "current"\n[columns]\ntime = 1\nposition = "2-7"\nvelocity'
        ' = "8-13"\ntorque = "14-19"\n',
        encoding="utf-8",
    )
    model = load_robot(shared / "models" / "ur10e.urdf")
    (recording,) = read_recordings(
        [shared / "data" / "ur10e" / log],
        model=model,
        sheet=sheet,
        gain=[14.87, 13.26, 11.13, 10.62, 11.03, 11.47],
    )

    def codes(of: Recording) -> list[str]:
        return [finding.code for finding in check_recording(model, of).findings]

    assert "joints_swapped" not in codes(recording)
    for pair in ((4, 5), (3, 5), (0, 5)):
        assert "joints_swapped" in codes(swapped(recording, *pair))


@pytest.mark.parametrize("robot", ["ur10e", "franka-panda"])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_dead_torque_is_swapped_with_none(robot: str, noise: float) -> None:
    """Whichever joint it is: a constant is explained by any joint, and noise by none."""
    model = bundled_robot(robot)
    for seed in (2, 3):
        recording = recorded(model, seed, duration=8.0)
        for k in range(model.n_joints):
            tau = recording.tau.copy()
            tau[:, k] = 3.21 + noise * np.random.default_rng(k).standard_normal(len(tau))
            assert find_swapped_torques(fit_of(model, replace(recording, tau=tau))) is None
