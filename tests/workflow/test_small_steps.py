"""A refinement finds the robot of small steps, though it simulates in large ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.identification.trajectories.arms import four_joint_arm, recorded_by_mujoco

from asbuilt.dynamics import PositionServo
from asbuilt.workflow import Study, StudyOptions, identify, refinement

pytest.importorskip("mujoco")
STEP, LATE = 1e-4, 0.010
SERVO = PositionServo(kp=(60.0, 60.0, 40.0, 25.0), kd=(2.0, 2.0, 1.0, 0.6), delay=LATE)


def studied(seed: int, *, refine: bool = True, **settings: float) -> Study:
    """Return the study of an arm that MuJoCo moved in steps of .1 ms, its delay unknown."""
    model = four_joint_arm(seed)
    given = {"duration": 24.0, "noise": 1e-4, "step": STEP} | settings
    recording = recorded_by_mujoco(model, SERVO, seed=seed, **given)
    recording = replace(recording, qd=None, servo=replace(SERVO, delay=None))
    options = StudyOptions(holdout="blocks:2s:3", refine="rollout" if refine else None)
    return identify(model, recording, options=options)


@pytest.mark.study
@pytest.mark.parametrize("seed", [2])
def test_delay_and_armatures_are_those_of_small_steps(seed: int) -> None:
    """Steps of 1 ms would make delays .5 ms longer and armatures up to 3 % smaller."""
    study = studied(seed)
    servo, refined = study.result.servo, study.refined
    assert servo is not None
    # MuJoCo's own steps are early by half of one
    assert servo.delay == pytest.approx(LATE - 0.5 * STEP, abs=5e-5)
    joints = study.result.model.joints
    armatures = {f"Ia{k + 1}": joint.drive.armature for k, joint in enumerate(joints)}
    found = {each.name: each.estimate for each in study.result.parameters}
    alone = {name: value for name, value in armatures.items() if name in found}
    assert alone
    for name, value in alone.items():
        assert found[name] == pytest.approx(value, rel=0.01), name
    assert refined is not None
    assert refined.kept
    assert refined.before is not None
    assert refined.after is not None
    assert refined.after.rms_all <= refined.before.rms_all


@pytest.mark.study
def test_a_refinement_that_simulates_worse_is_not_followed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fitted with a servo of half the stiffness, trajectories spoil the fit to torques."""
    fitted = refinement.refine_fit

    def spoilt(*args, **kwargs):
        found = fitted(*args, **kwargs)
        soft = replace(found.law.servo, kp=tuple(0.5 * kp for kp in found.law.servo.kp))
        return replace(
            found, robot=replace(found.robot, servo=soft), law=replace(found.law, servo=soft)
        )

    monkeypatch.setattr(refinement, "refine_fit", spoilt)
    study, linear = studied(1), studied(1, refine=False)
    assert study.refined is not None
    assert not study.refined.kept
    assert "refinement_rejected" in [finding.code for finding in study.findings]
    np.testing.assert_array_equal(study.result.estimates, linear.result.estimates)
    assert study.result.servo == linear.result.servo


@pytest.mark.study
@pytest.mark.parametrize(("seed", "soft"), [(2, 0.002), (2, 0.02), (3, 0.02)])
def test_soft_dry_friction_is_no_stribeck_friction(seed: int, soft: float) -> None:
    """Joints that stop softly seem to stick: 1.5 N m at rest beside .26 in motion were found."""
    study = studied(seed, soft=soft)
    assert study.refined is not None
    assert study.refined.kept
    assert "stribeck" not in study.result.base.drive.keys


@pytest.mark.study
def test_stribeck_friction_that_moves_the_robot_is_found() -> None:
    """A third of the Coulomb friction of the arm, in friction without softness."""
    study = studied(1, soft=4e-4, stribeck=0.15)
    assert "stribeck" in study.result.base.drive.keys
