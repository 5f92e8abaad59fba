"""A deadband of a position servo, recorded by MuJoCo, is found where there is one."""

import mujoco
import numpy as np
import pytest
from tests.identification.servo.test_servo_estimate import KP, RATE, ROBOT, STEP

from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.dynamics import DriveSet, PositionServo
from asbuilt.experiment import Recording, SignalChain, resolve_chain
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.identification.servo.servo_estimate import estimate_servo
from asbuilt.workflow.servo import CommandedTorque

DRIVE = DriveSet.parse("armature,viscous,coulomb")
WIDTH = 0.02


def recorded(seed, width, n=4000):
    """Return 40 s of the arm, whose actuators get goals moved by the deadband."""
    model = mujoco.MjModel.from_xml_string(ROBOT)
    model.geom_contype[:] = 0
    model.dof_solref[:], model.dof_solimp[:] = [0.004, 1.0], [0.99, 0.999, 0.001, 0.5, 2.0]
    data, per = mujoco.MjData(model), round(1.0 / RATE / STEP)
    rng, t = np.random.default_rng(seed), np.arange(n) / RATE
    frequencies = np.array([0.3, 0.55, 0.9, 1.7])
    sizes = rng.uniform(0.1, 0.5, (3, 4)) / frequencies
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, 4))
    u = np.sum(sizes * np.sin(2.0 * np.pi * frequencies * t[:, None, None] + phases), axis=2)
    data.qpos[:] = u[0]
    q = np.empty((n, 3))
    for k in range(n):
        q[k] = data.qpos
        for _ in range(per):
            error = u[k] - data.qpos
            data.ctrl[:] = data.qpos + np.sign(error) * np.maximum(np.abs(error) - width, 0.0)
            mujoco.mj_step(model, data)
    q += rng.normal(scale=1e-4, size=q.shape)
    return Recording(
        t=t, q=q, tau=np.zeros_like(q), command=u, joint_names=("pan", "lift", "elbow")
    )


def estimated(seed, width, kp=KP):
    stated = PositionServo(kp=kp, kd=(0.0,) * 3, deadband=(np.nan,) * 3)
    driven = drive_by_command(recorded(seed, width), stated)
    chain = resolve_chain(SignalChain(), driven)
    return estimate_servo(read_mjcf(ROBOT), [driven], DRIVE, chain)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.study)])
def test_a_deadband_is_found_and_named(seed):
    found = estimated(seed, WIDTH)
    assert found.servo.deadband == pytest.approx((WIDTH,) * 3, rel=0.15)
    assert abs(found.servo.deadband[0] - WIDTH) < 4.0 * found.errors.deadband
    codes = [each.code for each in CommandedTorque(found).findings(read_mjcf(ROBOT), DRIVE)]
    assert "servo_deadband" in codes
    assert "no torque within" in CommandedTorque(found).sentences(read_mjcf(ROBOT))[0]


@pytest.mark.study
@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.study) for seed in (2, 3))]
)
def test_no_deadband_is_found_where_there_is_none(seed):
    found = estimated(seed, 0.0)
    assert found.servo.deadband == (0.0,) * 3
    assert found.errors.deadband == 0.0


@pytest.mark.study
def test_a_deadband_is_found_without_gains():
    found = estimated(1, WIDTH, kp=(np.nan,) * 3)
    assert found.servo.deadband == pytest.approx((WIDTH,) * 3, rel=0.15)
    assert found.servo.kp == pytest.approx(KP, rel=0.1)
