"""Motions of legs about a posture: feet stand and nothing pushes in the air, by Pinocchio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.excitation.motions.on_legs import LegMotion, leg_motions

pin = pytest.importorskip("pinocchio")

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


@pytest.fixture(scope="module")
def file(shared: Path) -> Path:
    return shared / "models/solo12/solo12.urdf"


@pytest.fixture(scope="module")
def solo(file: Path) -> RobotModel:
    return load_robot(file, base="free", contacts=",".join(FEET))


@pytest.fixture(scope="module")
def engine(file: Path) -> pin.Model:
    """Pinocchio's robot in our coordinates x y z yaw pitch roll."""
    base = pin.JointModelComposite()
    for joint in (
        *(pin.JointModelPX(), pin.JointModelPY(), pin.JointModelPZ()),
        *(pin.JointModelRZ(), pin.JointModelRY(), pin.JointModelRX()),
    ):
        base.addJoint(joint)
    return pin.buildModelFromUrdf(str(file), base)


@pytest.fixture(scope="module")
def motions(solo: RobotModel, engine: pin.Model) -> dict[str, LegMotion]:
    names = list(engine.names)[2:]
    assert tuple(names) == solo.joint_names[6:]
    legs = [0.8 if "HFE" in name else -1.6 if "KFE" in name else 0.0 for name in names]
    posture = np.r_[0.3, -0.2, 0.25, 0.7, 0.02, -0.03, legs]
    return {each.name: each for each in leg_motions(solo, posture)}


def feet(engine: pin.Model, q: Array) -> Array:
    """Return the places of the feet (N, 4, 3)."""
    data, found = engine.createData(), []
    for each in q:
        pin.framesForwardKinematics(engine, data, each)
        found.append([data.oMf[engine.getFrameId(name)].translation.copy() for name in FEET])
    return np.array(found)


def test_feet_that_stand_stay_and_others_lift(
    engine: pin.Model, motions: dict[str, LegMotion]
) -> None:
    for name, motion in motions.items():
        if "air" in name:
            continue
        places = feet(engine, motion.q)
        ground = np.median(places, axis=0)
        for k in range(4):
            stands = motion.closed[:, k]
            assert np.abs(places[stands, k] - ground[k]).max() < 5e-4
            if "lifting" in name:
                assert (~stands).sum() == len(stands) // 4
                assert np.mean(places[~stands, k, 2] - ground[k, 2]) > 0.02
    assert len(motions) == 7


def test_the_base_moves_as_the_name_says(motions: dict[str, LegMotion]) -> None:
    for name, moved in (
        ("squats", [2]),
        ("swaying on standing feet", [0, 1]),
        ("leaning the trunk on standing feet", [4, 5]),
        ("twisting the trunk on standing feet", [3]),
    ):
        ranges = np.ptp(motions[name].q[:, :6], axis=0)
        assert np.flatnonzero(ranges > 1e-3).tolist() == moved
        assert np.all(ranges[np.flatnonzero(ranges < 1e-3)] == 0.0)


def test_nothing_pushes_in_the_air(engine: pin.Model, motions: dict[str, LegMotion]) -> None:
    motion, data = motions["hops with legs that swing in the air"], engine.createData()
    assert not motion.closed.any()
    for q, qd, qdd in list(zip(motion.q, motion.qd, motion.qdd, strict=True))[::20]:
        tau = pin.rnea(engine, data, q, qd, qdd)
        assert np.abs(tau[:6]).max() < 1e-6 * max(np.abs(tau[6:]).max(), 1.0)
        pin.computeCentroidalMomentum(engine, data, q, qd)
        assert np.abs(data.hg.vector).max() < 1e-9


def test_a_satellite_has_one_motion(file: Path) -> None:
    model = load_robot(file, base="free")
    (motion,) = leg_motions(model, np.zeros(model.n_joints))
    assert motion.name == "moving all joints at once"
    assert motion.share == 1.0
