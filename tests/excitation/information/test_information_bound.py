from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, inverse_dynamics, observation_matrix
from asbuilt.errors import MotionError
from asbuilt.excitation import Information, MotionBounds, information_bound, random_fourier
from asbuilt.excitation.information.information import draw_states, mean_information


@pytest.fixture(scope="module")
def two_link():
    model = load_robot("two-link")
    base = find_base_parameters(model, DriveSet.parse("viscous,offset"))
    information, bounds = Information.of(model, base), MotionBounds.assumed(model)
    torque = MotionBounds.of(model).torque
    return (
        model,
        base,
        information,
        bounds,
        torque,
        information_bound(model, information, bounds, torque=torque),
    )


def test_the_bound_is_that_of_the_convex_program(two_link) -> None:
    """Maximise log det over weights of states by an interior-point solver.

    Below the bound, and near it on the bound's own support.
    """
    model, base, _, bounds, torque, bound = two_link

    def best(states) -> float:
        tau = inverse_dynamics(model, *states)
        states = [x[(np.abs(tau) <= torque).all(axis=1)] for x in states]
        w = observation_matrix(model, *states, drive=base.drive, columns=base.columns).reshape(
            len(states[0]), model.n_joints, -1
        )
        size = np.sqrt(np.einsum("ski,ski->i", w, w) / len(w))
        w = w / size
        weights = cp.Variable(len(w), nonneg=True)
        rows = w.reshape(-1, w.shape[2])
        mean = (
            rows.T @ cp.diag(np.kron(np.eye(len(w)), np.ones((model.n_joints, 1))) @ weights) @ rows
        )
        program = cp.Problem(cp.Maximize(cp.log_det(mean)), [cp.sum(weights) == 1])
        return float(program.solve(solver=cp.CLARABEL)) + 2 * float(np.log(size).sum())

    assert best(draw_states(bounds, 150, np.random.default_rng(3), extreme=0.5)) < bound.upper
    heavy = np.argsort(-bound.weights)[:150]
    on_support = best([x[heavy] for x in bound.support])
    assert on_support == pytest.approx(bound.log_det, abs=0.02 * base.n_base)
    assert on_support <= bound.upper + 1e-6


def test_the_gap_is_small_and_the_support_admissible(two_link) -> None:
    model, base, _, bounds, torque, bound = two_link
    assert 0 <= bound.upper - bound.log_det < 0.05 * base.n_base
    assert bound.weights.sum() == pytest.approx(1.0)
    q, qd, qdd = bound.support
    assert np.all((q >= bounds.lower - 1e-9) & (q <= bounds.upper + 1e-9))
    assert np.all(np.abs(qd) <= bounds.velocity * (1 + 1e-9))
    assert np.all(np.abs(qdd) <= bounds.acceleration * (1 + 1e-9))
    assert np.all(np.abs(inverse_dynamics(model, q, qd, qdd)) <= torque * (1 + 1e-9))


def test_no_motion_within_the_limits_exceeds_the_bound(two_link) -> None:
    model, _, information, _, _, bound = two_link
    for seed in range(20):
        motion = random_fourier(model, rng=seed, duration=6.0, n_harmonics=8, fraction=1.0)
        states = motion.at(motion.sample_times(200.0))
        assert 0 < bound.efficiency(mean_information(information, *states)) < 1


def test_more_room_never_lowers_the_bound(two_link) -> None:
    model, _, information, _, _, bound = two_link
    narrow = information_bound(model, information, MotionBounds.assumed(model, 0.5))
    assert narrow.upper < bound.upper


def test_a_robot_that_is_nearly_too_heavy_has_a_bound_and_one_that_is_has_an_error() -> None:
    model = load_robot("kuka-iiwa7-r800")
    base = find_base_parameters(model, DriveSet.parse("viscous,offset"))
    information, bounds = Information.of(model, base), MotionBounds.assumed(model)
    torque = MotionBounds.of(model).torque
    # Four of the first 1500 random states keep these limits.
    weak = information_bound(model, information, bounds, torque=0.05 * torque, rounds=1)
    assert np.isfinite([weak.log_det, weak.upper]).all()
    with pytest.raises(MotionError, match="too few to determine all base parameters"):
        information_bound(model, information, bounds, torque=0.005 * torque)
