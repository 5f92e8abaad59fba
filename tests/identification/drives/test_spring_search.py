"""Springs that no file describes.

Found where one was put, none where none is, and the same in two recordings of a real arm.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.experiment.logs.readers import read_recordings
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.findings import Finding
from asbuilt.identification.drives.spring_search import suspected_springs
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.generalisation.hidden_causes import find_hidden_causes
from asbuilt.workflow.study import StudyOptions, identify

DRIVE = DriveSet.parse("viscous,coulomb,offset")


def sprung(case, stiffness, noise=0.02):
    """The samples of a trial with springs (n,) about its joints and residuals that last some
    samples.
    """
    rng = np.random.default_rng(5)
    samples = case.samples
    colour = rng.normal(size=samples.tau.shape)
    for k in range(1, len(colour)):
        colour[k] = 0.8 * colour[k - 1] + 0.6 * colour[k]
    size = np.sqrt(np.mean(samples.tau**2, axis=0))
    return replace(
        samples,
        tau=samples.tau + samples.q * stiffness + noise * size * colour,
        tau_raw=np.zeros(0),
    )


@pytest.mark.parametrize(
    ("robot", "joint", "stiffness"),
    [("kuka-iiwa7-r800", 5, 0.6), ("ur10e", 3, 2.0), ("puma-560", 4, 1.0)],
)
def test_a_spring_is_found_where_it_is_and_nowhere_else(trial, robot, joint, stiffness) -> None:
    case = trial(robot, "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    springs = np.zeros(case.model.n_joints)
    assert suspected_springs(case.model, [sprung(case, springs)], DRIVE) == ()
    springs[joint] = stiffness
    (found,) = suspected_springs(case.model, [sprung(case, springs)], DRIVE)
    assert found.joint == joint
    assert found.stiffness == pytest.approx(stiffness, rel=0.3)
    assert found.error_with < found.error_without
    assert case.model.joint_names[joint] in str(found)


def test_a_described_spring_and_too_short_a_recording_say_nothing(trial) -> None:
    case = trial("ur10e", "viscous,coulomb,offset", seed=22, duration=30.0, rate=20.0)
    springs = np.zeros(6)
    springs[3] = 2.0
    samples = sprung(case, springs)
    assert (
        suspected_springs(
            case.model, [samples], DRIVE.with_term(*DriveSet.parse("spring:joints=4").terms)
        )
        == ()
    )
    assert suspected_springs(case.model, [samples], DRIVE, block_seconds=20.0) == ()


def test_described_springs_stay_while_others_are_looked_for(trial) -> None:
    """A spring that the robot is known to have changes nothing about another.

    What it adds to the torque is in the terms of both fits.
    """
    case = trial("ur10e", "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    springs = np.zeros(6)
    springs[4] = 1.0
    (alone,) = suspected_springs(case.model, [sprung(case, springs)], DRIVE)
    springs[3] = 2.0
    described = DRIVE.with_term(*DriveSet.parse("spring:joints=4").terms)
    samples = sprung(case, springs)
    (beside,) = suspected_springs(case.model, [samples], described)
    assert beside.joint == alone.joint == 4
    assert beside.stiffness == pytest.approx(alone.stiffness, rel=1e-2)
    assert beside.error_with == pytest.approx(alone.error_with, rel=0.05)

    refused = replace(
        identify_samples(case.model, samples, drive=described),
        findings=(Finding("consistent_fit_rejected", "warning", "no real bodies"),),
    )
    (said,) = find_hidden_causes(refused, [samples], described).findings
    advised = said.cure.settings["drive"]
    assert DriveSet.parse(advised) == DRIVE.with_term(*DriveSet.parse("spring:joints=4/5").terms)


def test_two_recordings_of_a_real_arm_tell_of_the_same_spring(shared) -> None:
    model = load_robot(shared / "models/kuka_lwr4.urdf")
    found = []
    for number in (1, 2):
        recording = read_recordings(
            [shared / f"data/kuka_lwr4/measurements_{number}.npz"], model=model
        )[0]
        samples = prepare_samples(recording, resolve_chain(SignalChain(), recording))
        (spring,) = suspected_springs(model, [samples], DRIVE)
        found.append(spring)
    assert {spring.joint_name for spring in found} == {"lwr_6_joint"}
    assert found[0].stiffness == pytest.approx(found[1].stiffness, rel=0.2)


@pytest.mark.study
def test_a_study_says_what_a_spring_would_explain(shared) -> None:
    model = load_robot(shared / "models/kuka_lwr4.urdf")
    recordings = [
        read_recordings([shared / f"data/kuka_lwr4/measurements_{number}.npz"], model=model)[0]
        for number in (1, 2)
    ]
    study = identify(
        model, recordings[:1], validation=recordings[1:], options=StudyOptions(method="auto")
    )
    (said,) = [finding for finding in study.findings if finding.code == "spring_suspected"]
    assert "lwr_6_joint" in said.message
    assert said.cure.settings == {
        "drive": "viscous,coulomb,offset,spring:joints=7",
        "mounting": "estimate",
    }
    drive = DriveSet.parse("viscous,coulomb,offset,spring:joints=7")
    sprung_study = identify(
        model,
        recordings[:1],
        validation=recordings[1:],
        options=StudyOptions(method="consistent", drive=drive),
    )
    before, after = (each.validations[0].metrics_as_built.rms[6] for each in (study, sprung_study))
    assert after < 0.6 * before
    assert sprung_study.result.physically_consistent
