from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix
from asbuilt.errors import UsageError
from asbuilt.excitation import Information
from asbuilt.excitation.information import information as information_module
from asbuilt.excitation.information.information import DOptimality, mean_information


def prepared(robot: str, drive: str, noise=1.0):
    model = load_robot(robot)
    base = find_base_parameters(model, DriveSet.parse(drive))
    return model, base, Information.of(model, base, noise)


def drawn(n: int, samples: int = 60, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(-1, 1, (samples, n)) for _ in range(3)]


@pytest.mark.parametrize("robot", ["kuka-iiwa7-r800", "scara", "two-link"])
def test_information_is_the_weighted_gram_matrix_of_the_observations(
    robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = load_robot(robot)
    noise = np.linspace(0.5, 2.0, model.n_joints)
    model, base, information = prepared(robot, "viscous,coulomb,offset", noise)
    state = drawn(model.n_joints)
    w = (
        observation_matrix(model, *state, drive=base.drive, columns=base.columns)
        / np.tile(noise, 60)[:, None]
    )
    found = information.matrix(information.rows(*state, smooth=False), 60)
    assert found == pytest.approx(w.T @ w, rel=1e-10, abs=1e-9)
    monkeypatch.setattr(information_module, "AT_ONCE", 17)
    assert mean_information(information, *state) == pytest.approx(
        w.T @ w / 60, rel=1e-10, abs=1e-10
    )


@pytest.mark.parametrize(
    ("robot", "drive"),
    [
        ("two-link", "viscous,coulomb,offset"),
        ("scara", "armature,viscous"),
        ("kuka-iiwa7-r800", "coulomb"),
        ("ur10e", "none"),
    ],
)
def test_gradient_of_log_det_is_that_of_central_differences(robot: str, drive: str) -> None:
    model, _, information = prepared(robot, drive)
    state = [0.4 * x for x in drawn(model.n_joints)]
    _, inverse = DOptimality().value_and_gradient(information.matrix(information.rows(*state), 60))
    gradient = information.state_gradient(*state, information.rows(*state), inverse)

    def value(moved) -> float:
        return DOptimality().value(information.matrix(information.rows(*moved), 60))

    rng = np.random.default_rng(5)
    for order in range(3):
        way = rng.normal(size=state[0].shape)
        sides = [
            value([x + side * way if k == order else x for k, x in enumerate(state)])
            for side in (1e-6, -1e-6)
        ]
        assert (sides[0] - sides[1]) / 2e-6 == pytest.approx(
            float(np.sum(gradient[order] * way)), rel=2e-5, abs=1e-5
        )


def test_smooth_columns_differ_from_exact_ones_only_near_standstill() -> None:
    model, _, information = prepared("two-link", "viscous,coulomb,offset")
    q, qd, qdd = drawn(model.n_joints)
    qd = np.sign(qd) * (np.abs(qd) + 10 * information.width)
    assert information.rows(q, qd, qdd)[:, :60] == pytest.approx(
        information.rows(q, qd, qdd, smooth=False)[:, :60], abs=1e-7
    )


@pytest.mark.parametrize("noise", [0.0, [1.0, 2.0, 3.0], np.nan, [1.0, -1.0]])
def test_impossible_noise_is_refused(noise) -> None:
    with pytest.raises(UsageError, match="one positive number or one per joint"):
        prepared("two-link", "none", noise)
