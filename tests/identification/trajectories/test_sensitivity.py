"""Derivatives of simulated trajectories against central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.identification.trajectories.arms import SERVO, recorded_by_mujoco, servo_arm
from tests.identification.trajectories.test_simulation import samples_of

from asbuilt.arrays import Mask
from asbuilt.dynamics import find_base_parameters
from asbuilt.identification.trajectories.sensitivity import Motion, Trajectories
from asbuilt.identification.trajectories.simulated_robot import (
    SimulatedRobot,
    build_robot_as_described,
)
from asbuilt.identification.trajectories.windows import cut_windows

pytest.importorskip("mujoco")
SMALL = {"lead": (1e-5, 1e-5)}
"""A lead that is changed both ways without falling below zero."""


def before_reversals(motion: Motion, every: int) -> Mask:
    """Return at which samples no joint has been at rest or turned back since the start (W, L)."""
    sign = np.sign(motion.state - np.where(motion.state > 2.0, 4.0, 0.0))
    turned = np.any((sign == 0.0) | (sign != sign[:, :1]), axis=-1)
    return ~np.maximum.accumulate(turned, axis=1)[:, every - 1 :: every]


@pytest.mark.parametrize(
    "law",
    [
        SMALL,
        SMALL | {"deadband": (0.02, 0.01), "no_load_speed": (6.0, 9.0)},
        {"lead": (0.01, 0.02)},
    ],
    ids=["pd", "beyond", "lead"],
)
def test_derivatives_by_all_parameters_are_those_of_differences(law) -> None:
    model = servo_arm()
    recording = recorded_by_mujoco(model, SERVO, duration=2.0)
    servo = replace(SERVO, torque_limit=(6.0, 2.0), delay=0.0061, **law)
    windows = cut_windows(recording, samples_of(recording), 0.3)
    robot = build_robot_as_described(model, servo)
    base = find_base_parameters(model, robot.drive)
    trajectories = Trajectories(model, base)
    n, p = model.n_joints, base.n_base
    chi = np.concatenate([model.parameters, robot.values.ravel()])

    def positions(z, start=None):
        full = chi.copy()
        full[base.columns] += z[:p]
        changed = replace(
            servo,
            kp=tuple(np.array(servo.kp) + z[p : p + n]),
            kd=tuple(np.array(servo.kd) + z[p + n : p + 2 * n]),
            delay=servo.delay + z[-2],
            lead=tuple(servo.leads + z[-1]),
        )
        moved = SimulatedRobot(model, robot.drive, full[10 * n :].reshape(n, -1), changed)
        here = windows
        if start is not None:
            here = replace(
                windows, start_q=windows.start_q + start[:n], start_qd=windows.start_qd + start[n:]
            )
        motion = trajectories.simulate(moved, here, full[: 10 * n])
        return motion.sampled(windows.divisions)[:, 1:]

    motion = trajectories.simulate(robot, windows, chi[: 10 * n])
    assert np.any(motion.state > 2.0), "the servo must be at its limit somewhere"
    ((branch, _, found),) = trajectories.derivatives(robot, windows, chi[: 10 * n], motion)
    assert branch.parameters.tolist() == list(range(trajectories.n_parameters))
    none = np.zeros(trajectories.n_parameters)
    smooth = before_reversals(motion, windows.divisions)
    assert np.mean(smooth) > 0.4
    for k in range(trajectories.n_parameters + 2 * n):
        change = np.zeros(trajectories.n_parameters + 2 * n)
        change[k] = 1e-6
        z, start = np.split(change, [len(none)])
        slope = (positions(z, start) - positions(-z, -start))[smooth] / 2e-6
        size = np.abs(slope).max()
        # the limit begins in other steps for some samples
        assert np.median(np.abs(found[smooth][..., k] - slope)) < 1e-5 * size
        assert np.mean(np.abs(found[smooth][..., k] - slope) > 1e-3 * size) < 0.05
    needed = np.arange(trajectories.n_parameters) % 3 == 1
    ((branch, _, part),) = trajectories.derivatives(robot, windows, chi[: 10 * n], motion, needed)
    assert branch.parameters.tolist() == np.flatnonzero(needed).tolist()
    kept = np.concatenate([needed, np.ones(2 * n, dtype=bool)])
    np.testing.assert_allclose(part, found[..., kept], rtol=1e-12, atol=1e-15)


def test_derivatives_through_reversals_are_those_of_wide_differences_of_fine_steps() -> None:
    model = servo_arm()
    recording = recorded_by_mujoco(model, SERVO, duration=3.0)
    robot = build_robot_as_described(model, replace(SERVO, torque_limit=(np.inf, np.inf)))
    base = find_base_parameters(model, robot.drive)
    trajectories = Trajectories(model, base)
    windows = cut_windows(recording, samples_of(recording), 0.25)
    links = model.parameters

    def motion_of(cut, changed=robot):
        return trajectories.simulate(changed, cut, links)

    sign = np.sign(motion_of(windows).state)
    turning = np.all(np.any(sign[:, 1:] * sign[:, :-1] <= 0.0, axis=1), axis=1)
    some = np.flatnonzero(turning)[:3]
    assert some.size == 3
    fine = replace(windows.some(some), longest_step=4e-5)
    ((_, _, found),) = trajectories.derivatives(robot, fine, links, motion_of(fine))
    place = {name: k for k, name in enumerate(base.names)}
    n = model.n_joints
    for name, column in (("Fc1", 2), ("Fc2", 2), ("Fv1", 1), ("start 1", 0), ("start 2", 0)):
        joint = int(name[-1]) - 1
        if name in place:
            own = found[..., place[name]]
        else:
            own = found[..., trajectories.n_parameters + n + joint]
        wide = 2e-3 / np.abs(own).max()
        sides = []
        for sign in (1.0, -1.0):
            if name in place:
                values = robot.values.copy()
                values[joint, column] += sign * wide
                moved = motion_of(fine, replace(robot, values=values))
            else:
                start = fine.start_qd.copy()
                start[:, joint] += sign * wide
                moved = motion_of(replace(fine, start_qd=start))
            sides.append(moved.sampled(fine.divisions)[:, 1:])
        slope = (sides[0] - sides[1]) / (2.0 * wide)
        assert np.abs(own - slope).max() < 0.005 * np.abs(slope).max()
