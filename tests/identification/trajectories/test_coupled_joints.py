"""Simulated windows of a robot with joints that follow others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.dynamics import DriveSet, find_base_parameters, forward_dynamics
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.sensitivity import Trajectories
from asbuilt.identification.trajectories.simulated_robot import DriveSignal, SimulatedRobot
from asbuilt.identification.trajectories.windows import Windows
from coupled_robots import palletizer

DRIVE = DriveSet.parse("armature,viscous,coulomb,offset")
VALUES = np.array([0.1, 0.8, 0.0, 0.1])


@pytest.fixture(scope="module")
def windows() -> Windows:
    """Two windows of .1 s under torques that change, from random states."""
    rng = np.random.default_rng(5)
    t = np.linspace(0.0, 0.2, 41)
    torque = 5.0 * np.sin(10.0 * t[:, None] + rng.uniform(0, 6, 5))
    q, qd = 0.3 * rng.normal(size=(2, 5)), 0.3 * rng.normal(size=(2, 5))
    at = np.broadcast_to(q[:, None], (2, 11, 5))
    return Windows(
        "coupled",
        0.1,
        100.0,
        np.array([0.0, 0.1]),
        at,
        q,
        qd,
        DriveSignal("torque", t, torque),
        longest_step=1e-3,
    )


def test_steps_have_the_accelerations_of_the_coupled_robot(windows: Windows) -> None:
    """`a = M^-1 (tau - C qd - g)`, the forward dynamics that are those of MuJoCo's free tree."""
    model = palletizer()
    robot = SimulatedRobot(model, DRIVE, np.zeros((5, 4)))
    engine = Trajectories(model, find_base_parameters(model, DRIVE))
    motion = engine.simulate(robot, windows, model.parameters)
    q, v = (x[:, :-1].reshape(-1, 5) for x in (motion.q, motion.v))
    tau = windows.inputs(0.0, np.zeros(5)).reshape(-1, 5)
    expected = forward_dynamics(model, q, v, tau)
    np.testing.assert_allclose(motion.a.reshape(-1, 5), expected, rtol=1e-8, atol=1e-8)


def test_both_engines_agree(windows: Windows) -> None:
    """MuJoCo's couplings are equality constraints, soft by 1e-4 of the accelerations."""
    model = palletizer()
    robot = SimulatedRobot(model, DRIVE, np.tile(VALUES, (5, 1)))
    engine = Trajectories(model, find_base_parameters(model, DRIVE))
    motion = engine.simulate(robot, windows, model.parameters)
    own, other = motion.sampled(windows.divisions), simulate_windows(robot, windows)
    moved = np.abs(own - own[:, :1]).max()
    assert moved > 0.02
    np.testing.assert_allclose(other, own, atol=3e-3 * moved)


@pytest.mark.study
def test_derivatives_by_all_parameters_are_those_of_differences(windows: Windows) -> None:
    model = palletizer()
    robot = SimulatedRobot(model, DRIVE, np.tile(VALUES, (5, 1)))
    base = find_base_parameters(model, DRIVE)
    engine, links = Trajectories(model, base), 10 * model.n_links
    chi = np.concatenate([model.parameters, robot.values.ravel()])

    def positions(change: np.ndarray) -> np.ndarray:
        full, (z, start) = chi.copy(), np.split(change, [engine.n_parameters])
        full[base.columns] += z[: base.n_base]
        begin = replace(
            windows, start_q=windows.start_q + start[:5], start_qd=windows.start_qd + start[5:]
        )
        moved = SimulatedRobot(model, DRIVE, full[links:].reshape(5, -1))
        return engine.simulate(moved, begin, full[:links]).sampled(windows.divisions)[:, 1:]

    motion = engine.simulate(robot, windows, chi[:links])
    ((branch, _, found),) = engine.derivatives(robot, windows, chi[:links], motion)
    assert branch.joints.tolist() == [0, 1, 2, 3, 4]
    places = [*branch.parameters.tolist(), *range(engine.n_parameters, engine.n_parameters + 10)]
    names = base.names
    for column, place in enumerate(places):
        if place < base.n_base and names[place].startswith("Fc"):
            continue  # dry friction of none has another sign for each side
        change = np.zeros(engine.n_parameters + 10)
        change[place] = 1e-6
        slope = (positions(change) - positions(-change)) / 2e-6
        size = max(np.abs(slope).max(), 1e-3)
        np.testing.assert_allclose(found[..., column], slope, atol=2e-5 * size, err_msg=str(place))
