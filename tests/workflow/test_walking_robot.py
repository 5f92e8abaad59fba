"""A real quadruped from pose, joints, torques and contact flags (Khorshidi et al., 2025)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt import identify, roll_out_robot
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics import PositionServo, link_poses
from asbuilt.errors import RecordingError, UsageError
from asbuilt.experiment import Recording, read_fitted_recordings, read_recording
from asbuilt.experiment.free_base.base_checks import check_free_base
from asbuilt.experiment.free_base.columns import add_base_coordinates, base_rotations
from asbuilt.writers import as_built
from studied_cases import first_of

FEET = "FL_FOOT,FR_FOOT,HL_FOOT,HR_FOOT"


@pytest.fixture(scope="module")
def solo(shared: Path) -> RobotModel:
    return load_robot(shared / "models/solo12/solo12.urdf", base="free", contacts=FEET)


@pytest.fixture(scope="module")
def log(shared: Path, solo: RobotModel) -> Recording:
    return read_recording(shared / "data/solo12/solo12.csv", model=solo, torque_source="motor")


def errors(model: RobotModel, recording: Recording) -> list[str]:
    found = check_free_base(model, recording)
    return [each.code for each in found if each.severity == "error"]


def test_a_sound_log_has_no_errors(solo: RobotModel, log: Recording) -> None:
    assert errors(solo, log) == []


@pytest.mark.study
def test_errors_of_a_real_log_are_named(solo: RobotModel, log: Recording) -> None:
    assert log.qd is not None
    assert log.contact is not None
    turned = np.einsum("sij,sj->si", base_rotations(log.q), log.qd[:, :3])
    wrong = replace(log, qd=np.hstack([turned, log.qd[:, 3:]]))
    assert errors(solo, wrong) == ["base_velocity_axes"]
    for late in (-5, 5):
        shifted = replace(log, contact=np.roll(log.contact, late, axis=0))
        assert errors(solo, shifted) == ["contact_timing"]
    assert errors(solo, replace(log, contact=0.0 * log.contact)) == ["contact_never_closes"]


def test_feet_roll_on_the_radius_at_which_they_stand(solo: RobotModel, log: Recording) -> None:
    """The ground is at 0: the height of a frame in stance, which rolling does not use."""
    assert log.contact is not None
    model, _ = read_fitted_recordings(solo, [log])
    poses = link_poses(solo, log.q)
    for contact, closed in zip(model.contacts, log.contact.T > 0.5, strict=True):
        link, placement = solo.placed(contact.frame)
        height = np.median((poses[closed, link] @ placement)[:, 2, 3])
        assert contact.radius == pytest.approx(height, abs=1e-3)
    reports = {each.code for each in check_free_base(model, log)}
    assert "feet_roll" in reports
    assert "contact_radius" not in reports


@pytest.mark.parametrize("stated", first_of(1, ["0", "0.03", "flat"]))
def test_a_stated_kind_of_foot_is_kept_and_a_wrong_one_named(
    shared: Path, log: Recording, stated: str
) -> None:
    feet = ",".join(f"{foot}:{stated}" for foot in FEET.split(","))
    other = load_robot(shared / "models/solo12/solo12.urdf", base="free", contacts=feet)
    assert read_fitted_recordings(other, [log])[0].contacts == other.contacts
    (finding,) = (x for x in check_free_base(other, log) if x.code == "contact_radius")
    assert "FL_FOOT 18.6 mm" in finding.message


@pytest.mark.study
def test_solo12_predicts_its_last_eight_seconds(solo: RobotModel, log: Recording) -> None:
    """A published pipeline reaches 12.5 % of the projected torque where CAD has 21.3 %."""
    study = identify(solo, log, holdout="last:0.4", total_mass="2.50+-0.01")
    (held,) = study.validations
    assert held.metrics_as_built.relative_error < 0.025
    assert held.metrics_as_built.relative_error < held.metrics_cad.relative_error
    assert study.result.physically_consistent
    built = as_built(study.result).model
    assert sum(link.inertia.mass for link in built.links) == pytest.approx(2.50, rel=0.03)
    assert "poorly_determined" in {finding.code for finding in study.findings}


def test_a_refinement_on_the_ground_is_refused_at_once(solo: RobotModel, log: Recording) -> None:
    with pytest.raises(UsageError, match="jumps where feet strike"):
        identify(solo, log, refine="rollout")


@pytest.mark.study
def test_a_real_robot_is_simulated_under_its_torques(solo: RobotModel, log: Recording) -> None:
    """Nothing holds it but its torques: errors grow, and those of the base are a millimetre."""
    pytest.importorskip("mujoco")
    short, long = (each.cad for each in roll_out_robot(solo, log, (0.03, 0.1)))
    assert short is not None
    assert short.base is not None
    assert long is not None
    assert long.base is not None
    assert short.base[0] < 2e-4
    assert short.base[1] < 5e-3
    assert long.base[0] < 1.5e-3
    assert long.diverged == 0
    study = identify(solo, log, holdout="last:0.4", total_mass="2.50+-0.01", rollout=(0.05,))
    (found,) = study.rollouts
    assert found.cad is not None
    assert found.as_built is not None
    assert found.cad.base is not None
    assert found.as_built.base is not None
    assert found.as_built.rms_all < found.cad.rms_all
    assert found.as_built.base[0] < found.cad.base[0]
    assert found.as_built.base[1] < found.cad.base[1]


def test_commands_and_forces_on_the_base_are_refused(solo: RobotModel, log: Recording) -> None:
    n = log.n_joints - 6
    bare = log.reordered(log.joint_names[6:])
    joints = replace(
        bare,
        undriven=(),
        contact=None,
        torque_source="command",
        command=bare.q,
        servo=PositionServo(kp=(10.0,) * n, kd=(0.2,) * n),
        extra={"base_fx": log.t},
    )
    with pytest.raises(RecordingError, match="forces on the base"):
        add_base_coordinates(joints, solo)
