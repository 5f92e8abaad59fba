"""A robot of millimetres and one of kilometres are identified as one of metres.

With lengths, gravity and torques in other units every number is the same but for its unit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt import identify
from asbuilt.description import bundled_robot
from asbuilt.description.appearance import find_size_units
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples, VirtualRobot
from asbuilt.identification import fit_least_squares
from asbuilt.identification.information.square_root_information import accumulate

DRIVE = DriveSet.parse("viscous,coulomb,offset,load_friction")


def scaled(model, length):
    """Return a robot of other lengths under another gravity, its masses the same."""
    joints = []
    for joint in model.joints:
        before, after = np.array(joint.before), np.array(joint.after)
        before[:3, 3] *= length
        after[:3, 3] *= length
        limits = replace(joint.limits, torque=joint.limits.torque * length**2)
        drive = type(joint.drive)()
        joints.append(replace(joint, before=before, after=after, limits=limits, drive=drive))
    bodies = model.parameters.reshape(-1, 10) * np.repeat([length**2, length, 1.0], [6, 3, 1])
    other = replace(
        model, joints=tuple(joints), frames=(), gravity=np.array(model.gravity) * length
    )
    return other.with_parameters(bodies.ravel())


@pytest.fixture(scope="module")
def studies():
    model = scaled(bundled_robot("two-link"), 1.0)
    machine = VirtualRobot.ideal(model).with_drive(DRIVE, np.tile([1.0, 2.0, 0.3, 0.1], 2))
    log = machine.record(random_fourier(model, rng=1, duration=25.0), rate=100.0).recording
    tau = log.tau + 0.05 * np.random.default_rng(1).normal(size=log.tau.shape)
    log = replace(log, tau=tau, qd=None, qdd=None, torque_source="motor")
    return {
        length: identify(scaled(model, length), replace(log, tau=length**2 * log.tau))
        for length in (1.0, 1e-3, 10.0, 1e3)
    }


@pytest.mark.study
@pytest.mark.parametrize("length", [1e-3, 10.0, 1e3])
def test_effects_and_significance_do_not_depend_on_the_unit_of_length(studies, length):
    own, other = studies[1.0], studies[length]
    named = [(each.effect, each.joint, each.in_model) for each in own.effects]
    assert ("load_friction", "joint_2", True) in named
    assert [(each.effect, each.joint, each.in_model) for each in other.effects] == named
    # Whether such bodies can exist is another question: 2 kg on a millimetre are no matter.
    assert other.verdict.use != "no"
    assert other.result.base.names == own.result.base.names
    sigmas = [study.result.estimates / study.result.std_errors for study in (own, other)]
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=1e-3, atol=1e-3)
    assert other.result.train.relative_error == pytest.approx(own.result.train.relative_error)


@pytest.mark.parametrize("length", [1e-7, 1e3])
def test_what_is_open_does_not_depend_on_the_unit_of_length(length: float) -> None:
    """Joints at rest leave sums open of quantities with different powers of the length."""
    robot = bundled_robot("kuka-iiwa7-r800")
    rng = np.random.default_rng(2)
    motion = rng.uniform(-2.0, 2.0, (3, 400, 7))
    motion[:, :, [2, 5]] = np.array([0.3, 0.0, 0.0])[:, None, None]

    def open_parameters(size: float) -> set[str]:
        model = scaled(robot, size)
        base = find_base_parameters(model, DriveSet.parse("viscous"))
        samples = Samples(
            np.arange(400) / 100.0,
            *motion,
            np.zeros((400, 7)),
            rate=100.0,
            joint_names=model.joint_names,
        )
        estimate = fit_least_squares(accumulate(model, base, samples), prior=np.zeros(base.n_base))
        return {n for n, known in zip(base.names, estimate.determined, strict=True) if not known}

    assert len(open_parameters(1.0)) > 5
    assert open_parameters(length) == open_parameters(1.0)


@pytest.mark.parametrize(("length", "unit"), [(1.0, 1.0), (1e-3, 1e-3), (3.0, 1.0), (1e3, 1e3)])
def test_arms_are_of_metres_and_kilograms(length: float, unit: float) -> None:
    units = find_size_units(scaled(bundled_robot("two-link"), length))
    assert units == (unit, 1.0)
    assert units.torque(revolute=True) == pytest.approx(unit**2)
