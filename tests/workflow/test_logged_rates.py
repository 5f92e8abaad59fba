"""Which rates of a free base are used: those that give its torque, not those without noise.

The robot stands on one sole, whose wrench is what leaves the base without a drive.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.dynamics.reactions import contact_jacobians
from asbuilt.experiment import Recording, SignalChain
from asbuilt.experiment.signal.band_choice import choose_band
from asbuilt.experiment.signal.preparation import MotionFilters, plan_grid
from asbuilt.identification.uncertainty.pose_noise import settle_rates

URDF = """<robot name="monopod">
  <link name="trunk"><inertial><origin xyz=".02 .01 .05"/><mass value="4"/>
    <inertia ixx=".05" ixy=".01" ixz="0" iyy=".04" iyz="0" izz=".06"/></inertial></link>
  <link name="thigh"><inertial><origin xyz="0 .01 -.1"/><mass value=".9"/>
    <inertia ixx=".004" ixy="0" ixz="0" iyy=".005" iyz="0" izz=".002"/></inertial></link>
  <link name="shank"><inertial><origin xyz=".01 0 -.1"/><mass value=".5"/>
    <inertia ixx=".002" ixy="0" ixz="0" iyy=".003" iyz="0" izz=".001"/></inertial></link>
  <joint name="hip" type="continuous"><parent link="trunk"/><child link="thigh"/>
    <axis xyz="1 0 0"/></joint>
  <joint name="knee" type="continuous"><parent link="thigh"/><child link="shank"/>
    <origin xyz="0 0 -.2"/><axis xyz="0 1 0"/></joint></robot>"""
RATE = 100.0


@pytest.fixture(scope="module")
def monopod(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    file = tmp_path_factory.mktemp("monopod") / "monopod.urdf"
    file.write_text(URDF)
    return load_robot(file, base="free", contacts="shank:flat")


@pytest.fixture(scope="module")
def log(monopod: RobotModel) -> Recording:
    t, n = np.arange(0.0, 15.0, 1.0 / RATE), monopod.n_joints
    rng = np.random.default_rng(3)
    w = 2.0 * np.pi * rng.uniform(0.5, 9.0, (n, 4))
    size, phase = rng.uniform(0.3, 1.0, (n, 4)) / w, rng.uniform(0.0, 6.0, (n, 4))
    angle = t[:, None, None] * w + phase
    q = np.sum(size * np.sin(angle), axis=2)
    qd, qdd = np.sum(size * w * np.cos(angle), axis=2), -np.sum(size * w**2 * np.sin(angle), axis=2)
    (J,) = contact_jacobians(monopod, q)
    torque = inverse_dynamics(monopod, q, qd, qdd)
    wrench = np.linalg.solve(np.swapaxes(J[:, :, :6], 1, 2), torque[:, :6, None])
    tau = torque - np.einsum("sij,si->sj", J, wrench[:, :, 0])
    assert np.abs(tau[:, :6]).max() < 1e-9 * np.abs(torque).max()
    return Recording(
        t=t,
        q=q,
        tau=tau,
        qd=qd,
        qdd=qdd,
        joint_names=monopod.joint_names,
        undriven=monopod.joint_names[:6],
        contact=np.ones((len(t), 1)),
    )


def chosen(model: RobotModel, recording: Recording, chain: SignalChain | None = None) -> str:
    return settle_rates(model, [recording], chain or SignalChain(), MotionFilters()).velocity


def late(x: Array | None, samples: int) -> Array:
    return np.roll(np.asarray(x), samples, axis=0)


def test_rates_that_give_the_torque_are_used(monopod: RobotModel, log: Recording) -> None:
    assert chosen(monopod, log) == "measured"
    coarse = replace(log, q=np.round(log.q, 4))
    assert chosen(monopod, coarse) == "measured"


def test_rates_that_do_not_give_it_are_not(monopod: RobotModel, log: Recording) -> None:
    lagging = replace(log, qd=late(log.qd, 3), qdd=late(log.qdd, 3))
    assert chosen(monopod, lagging) == "derived"
    rough = np.random.default_rng(4).normal(size=log.q.shape) * np.std(log.qdd)
    noisy = replace(log, qdd=np.asarray(log.qdd) + rough)
    assert chosen(monopod, noisy) == "derived"


def test_what_is_stated_or_not_logged_is_left(monopod: RobotModel, log: Recording) -> None:
    assert chosen(monopod, log, SignalChain(velocity="derived")) == "derived"
    assert chosen(monopod, replace(log, qd=None)) == "auto"


def test_logged_accelerations_are_kept_further_up(log: Recording) -> None:
    """Nothing differences them; central differences lose a quarter at a fifth of the rate."""
    segments = plan_grid(log, SignalChain()).uniform()
    without = [replace(segment, qdd=None) for segment in segments]
    assert choose_band(without, RATE, of_velocity=True).wanted == pytest.approx(0.2 * RATE)
    assert choose_band(segments, RATE).wanted == pytest.approx(0.2 * RATE)
    assert choose_band(segments, RATE, of_velocity=True).wanted == pytest.approx(0.4 * RATE)
