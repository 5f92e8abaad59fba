"""Torque sensors that answer to other joints: what is named, with which entries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, inverse_dynamics
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot, prepare_samples
from asbuilt.identification import find_effects
from asbuilt.identification.effects.effect import Described, Motion
from asbuilt.identification.effects.families.crosstalk import CrossTalk

DRIVE = DriveSet.parse("viscous,coulomb,offset")
MODEL = bundled_robot("ur10e")


def found(source, seed=1):
    """Return what is found where 2 % of joint 2's torque reach the sensor of joint 1."""
    machine = VirtualRobot.ideal(MODEL).with_drive(DRIVE, np.tile([1.0, 2.0, 0.3], 6))
    log = machine.record(random_fourier(MODEL, rng=seed, duration=30.0), rate=100.0).recording
    tau = np.array(log.tau)
    tau[:, 0] += 0.02 * tau[:, 1]
    tau += 0.05 * np.random.default_rng(seed).normal(size=tau.shape)
    log = replace(log, tau=tau, qd=None, qdd=None, torque_source=source)
    return find_effects(MODEL, DRIVE, [prepare_samples(log)]).found


def test_columns_are_the_torques_of_the_other_joints_in_their_order() -> None:
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 5, 6))
    base = find_base_parameters(MODEL, DriveSet())
    robot = Described(MODEL, base, MODEL.parameters, "sensor", (qd,), np.ones(6))
    (variant,) = CrossTalk().variants(robot)
    columns = CrossTalk().columns(variant, Motion(robot, 100.0, q, qd, qdd, np.zeros(5)))
    tau = inverse_dynamics(MODEL, q, qd, qdd)
    for k in range(6):
        names = CrossTalk().name_parts([str(j) for j in range(6)], k)
        for column, name in zip(columns, names, strict=True):
            np.testing.assert_allclose(column[:, k], tau[:, int(name)], rtol=1e-12)


@pytest.mark.study
def test_a_sensor_that_answers_to_another_joint_is_named_with_its_share() -> None:
    (effect,) = (each for each in found("sensor") if each.effect == "crosstalk")
    assert effect.joint == MODEL.joint_names[0]
    share = float(effect.text.partition("(")[2].split()[0])
    assert share == pytest.approx(2.0, abs=0.05)
    assert f"% of {MODEL.joint_names[1]}" in effect.text
    assert not effect.in_model
    assert not any(each.effect == "gain" for each in found("sensor"))
    finding = CrossTalk().finding(effect, MODEL)
    assert finding.code == "sensor_crosstalk"
    assert "is no cure" in str(finding.cure)


@pytest.mark.study
def test_currents_have_no_other_joint_in_them() -> None:
    assert not any(each.effect == "crosstalk" for each in found("motor"))
