"""Effects that no file describes: found where one was put, none where none is.

The truth is put into samples whose torques Pinocchio's equal (`trial`), or recorded on real arms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, available_terms, find_base_parameters
from asbuilt.errors import UsageError
from asbuilt.experiment import SignalChain, prepare_samples, read_recordings, resolve_chain
from asbuilt.identification import EFFECTS, find_effects, identify_samples
from asbuilt.identification.effects.effect import Described, EffectsWanted
from asbuilt.identification.effects.effect_findings import describe_stated
from asbuilt.identification.identify import fit_samples
from asbuilt.validation import validate_samples
from asbuilt.workflow import StudyOptions, identify

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
    [
        pytest.param("kuka-iiwa7-r800", 5, 0.6, marks=pytest.mark.study),
        ("ur10e", 3, 2.0),
        pytest.param("puma-560", 4, 1.0, marks=pytest.mark.study),
    ],
)
def test_a_spring_is_found_where_it_is_and_nowhere_else(trial, robot, joint, stiffness) -> None:
    case = trial(robot, "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    springs = np.zeros(case.model.n_joints)
    assert find_effects(case.model, DRIVE, [sprung(case, springs)]).found == ()
    springs[joint] = stiffness
    effects = find_effects(case.model, DRIVE, [sprung(case, springs)])
    (found,) = effects.found
    assert (found.effect, found.joint) == ("spring", case.model.joint_names[joint])
    assert found.estimate == pytest.approx(stiffness, rel=0.3)
    assert found.unit == "N m/rad"
    assert found.in_model
    assert found.error_after < found.error_before
    assert case.model.joint_names[joint] in found.text
    assert effects.drive == DRIVE.with_term(*DriveSet.parse(f"spring:joints={joint + 1}").terms)
    named = find_effects(case.model, DRIVE, [sprung(case, springs)], applied=())
    assert (named.drive, named.found[0].in_model) == (DRIVE, False)
    assert named.lacking is not None


@pytest.mark.study
def test_a_described_spring_and_too_short_a_recording_show_nothing(trial) -> None:
    case = trial("ur10e", "viscous,coulomb,offset", seed=22, duration=30.0, rate=20.0)
    springs = np.zeros(6)
    springs[3] = 2.0
    samples = sprung(case, springs)
    described = DRIVE.with_term(*DriveSet.parse("spring:joints=4").terms)
    assert find_effects(case.model, described, [samples]).found == ()
    short = samples.between(samples.t[0], samples.t[0] + 2.0)
    assert find_effects(case.model, DRIVE, [short]).found == ()
    assert "too few" in find_effects(case.model, DRIVE, [short]).problem


@pytest.mark.study
def test_described_springs_stay_while_others_are_found(trial) -> None:
    """A spring that the robot is known to have changes nothing about another."""
    case = trial("ur10e", "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    springs = np.zeros(6)
    springs[4] = 1.0
    (alone,) = find_effects(case.model, DRIVE, [sprung(case, springs)]).found
    springs[3] = 2.0
    described = DRIVE.with_term(*DriveSet.parse("spring:joints=4").terms)
    effects = find_effects(case.model, described, [sprung(case, springs)])
    (other,) = effects.found
    assert other.joint == alone.joint == case.model.joint_names[4]
    assert other.estimate == pytest.approx(alone.estimate, rel=1e-2)
    assert effects.drive == DRIVE.with_term(*DriveSet.parse("spring:joints=4/5").terms)


def test_a_stated_effect_is_shown_as_one_that_is_found(trial) -> None:
    """Value, error and torque errors without and with it are those of two roads."""
    case = trial("ur10e", "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    springs = np.zeros(6)
    springs[3] = 2.0
    samples = sprung(case, springs)
    (found,) = find_effects(case.model, DRIVE, [samples]).found
    stated = DriveSet.parse("spring:joints=4")
    drive = DRIVE.with_term(stated.terms[0])
    fit = fit_samples(case.model, [samples], drive=drive, method="consistent")
    (shown,) = describe_stated(stated, fit, fit.concluded(*fit.metrics([samples])))
    assert (shown.effect, shown.joint, shown.unit) == (found.effect, found.joint, found.unit)
    assert shown.in_model
    assert shown.estimate == pytest.approx(2.0, abs=3.0 * shown.std_error)
    assert shown.torque == pytest.approx(2.0 * np.sqrt(np.mean(samples.q[:, 3] ** 2)), rel=0.05)
    # groups of like motion are formed with the column of the spring, and differ
    assert shown.error_before == pytest.approx(found.error_before, rel=0.25)
    assert shown.error_after == pytest.approx(found.error_after, rel=0.1)
    named = find_effects(case.model, drive, [samples])
    assert all(each.effect != "balancer" for each in named.found), "another form of the same"
    assert not any(at == ("balancer", 3) for at in named.unseen), "it is not looked for"


@pytest.mark.study
def test_a_curve_over_position_is_found_as_a_cable_beside_described_terms(trial) -> None:
    """What only a description states, or has columns that are zero by it, is in nobody's way."""
    case = trial("ur10e", "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    samples = sprung(case, np.zeros(6))
    x = samples.q[:, 3] / np.pi
    samples = replace(samples, tau=samples.tau + np.outer(8.0 * x**3 - 4.0 * x**2, np.eye(6)[3]))
    spring = "extension_spring:joints=2:inner=0.03:outer=0.2:angle=0.4:length=0.1"
    for described in ("", f",{spring},cable:joints=2:order=2"):
        drive = DriveSet.parse(f"viscous,coulomb,offset{described}")
        effects = find_effects(case.model, drive, [samples])
        (found,) = effects.found
        assert (found.effect, found.joint) == ("cable", case.model.joint_names[3])
        assert found.error_after < 0.8 * found.error_before
        assert not found.in_model  # a cubic extrapolates badly
        assert effects.drive == drive


@pytest.mark.parametrize(
    ("robot", "joint", "start"),
    [("ur10e", 3, 0.4), pytest.param("puma-560", 4, -1.0, marks=pytest.mark.study)],
)
def test_a_force_between_two_points_is_a_balancer_and_in_the_model(
    trial, robot, joint, start
) -> None:
    """By the energy of an extension spring, whose difference quotient is its torque."""
    case = trial(robot, "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    n, samples = case.model.n_joints, sprung(case, np.zeros(case.model.n_joints))

    def energy(q):
        length = np.sqrt(0.4**2 + 0.2**2 - 2 * 0.4 * 0.2 * np.cos(q - start))
        return 100.0 * (length - 0.15) ** 2

    q = samples.q[:, joint]
    torque = (energy(q + 1e-5) - energy(q - 1e-5)) / 2e-5
    tau = samples.tau + np.outer(torque, np.eye(n)[joint])
    effects = find_effects(case.model, DRIVE, [replace(samples, tau=tau)])
    (found,) = effects.found
    assert (found.effect, found.joint) == ("balancer", case.model.joint_names[joint])
    assert found.in_model
    assert found.error_after < 0.8 * found.error_before
    (term,) = (each for each in effects.drive.terms if each.key == "balancer")
    assert term.joints == (joint + 1,)
    assert term.at(joint).value("harmonics") == 2.0


def test_terms_that_only_a_description_states_are_not_sought() -> None:
    model = load_robot("ur10e")
    base = find_base_parameters(model, DRIVE)
    robot = Described(model, base, np.zeros(78), "sensor", (np.ones((9, 6)),), np.ones(6))
    sought = [(v.effect.key, v.n_columns) for _, e in EFFECTS.items() for v in e.variants(robot)]
    assert not {"extension_spring", "motor_cable"} & {key for key, _ in sought}
    # neither a cable nor a force between two points wins by its number of columns
    assert [m for key, m in sought if key == "cable"] == [4]
    assert [m for key, m in sought if key == "balancer"] == [2, 4]
    assert available_terms()["cable"].can_be_found
    stated = DriveSet.parse("extension_spring:inner=1:outer=1:angle=0:length=1").terms[0]
    assert stated.can_be_found
    kinds = {key: e.kind for key, e in EFFECTS.items()}
    assert {kinds[key] for key in ("spring", "balancer", "cable")} == {"position"}
    assert kinds["stribeck"] == "friction"
    assert kinds["load_friction"] == "load"


@pytest.mark.study
@pytest.mark.parametrize("angle", [-2.0])
def test_a_tilt_has_the_sign_of_the_world_and_turns_gravity_back(trial, angle) -> None:
    """A base turned by +3 deg about x reads +3 deg.

    The description's gravity is turned by +3 deg against that of the samples: the base that saw
    the samples is turned by +3 deg against the described one.
    """
    case = trial("ur10e", "viscous,coulomb,offset", seed=23, duration=60.0, rate=20.0)
    level = np.array(case.model.gravity)
    described = case.model.with_gravity(
        Rotation.from_rotvec([np.deg2rad(angle), 0.0, 0.0]).apply(level)
    )
    effects = find_effects(described, DRIVE, [sprung(case, np.zeros(6))])
    (found,) = effects.found
    assert (found.effect, found.joint) == ("tilt", None)
    np.testing.assert_allclose(effects.model.gravity, level, atol=0.03)
    assert found.estimate == pytest.approx(abs(angle), abs=0.2)
    assert f"({angle:+.0f}"[:2] in found.text


def test_what_is_wanted_is_read_from_text() -> None:
    assert EffectsWanted.parse("auto").choice == "auto"
    stated = EffectsWanted.parse("spring:joints=2,tilt")
    assert (stated.choice, str(stated.drive), stated.tilt) == ("list", "spring:joints=2", True)
    assert str(stated) == "spring:joints=2,tilt"
    with pytest.raises(UsageError, match="did you mean 'spring'"):
        StudyOptions(effects="sprang")
    for key, why in {
        "gain": "error of the log.*recording sheet",
        "payload:joints=2": "part of the bodies",
        "presliding": "no place in a model",
        "tilt:joints=2": "whole robot",
    }.items():
        with pytest.raises(UsageError, match=why):
            StudyOptions(effects=key)
    with pytest.raises(UsageError, match="neither auto, find or none"):
        StudyOptions(effects="auto,tilt")


@pytest.mark.study
def test_friction_with_a_parameter_of_its_own_at_each_joint_is_in_the_model(trial) -> None:
    """Trial values of nonlinear parameters differ by joint; what they add has its bias too."""
    case = trial("ur10e", "viscous,coulomb,offset", seed=21, duration=60.0, rate=20.0)
    samples = sprung(case, np.zeros(6))
    qd = samples.qd[:, 1]
    power = 12.0 * np.sign(qd) * np.abs(qd) ** 0.5
    effects = find_effects(
        case.model, DRIVE, [replace(samples, tau=samples.tau + np.outer(power, np.eye(6)[1]))]
    )
    assert effects.problem == ""
    kinds = {EFFECTS[each.effect].kind for each in effects.found if each.joint}
    assert kinds == {"friction"}
    assert all(each.joint == case.model.joint_names[1] for each in effects.found)


@pytest.mark.study
def test_effects_of_a_real_arm_predict_its_other_motion(shared) -> None:
    """LWR4+: trained on one motion, another one is predicted better with what was found."""
    model = load_robot(shared / "models/kuka_lwr4.urdf")
    logs = [
        read_recordings([shared / f"data/kuka_lwr4/measurements_{number}.npz"], model=model)[0]
        for number in (1, 2, 3)
    ]
    samples = [prepare_samples(each, resolve_chain(SignalChain(), each)) for each in logs]
    effects = find_effects(model, DRIVE, samples[:2])
    assert {"tilt"} <= {each.effect for each in effects.found}
    assert "lwr_6_joint" in {each.joint for each in effects.found}
    none, auto = (
        validate_samples(
            identify_samples(robot, samples[:2], drive=drive, method="auto"), samples[2]
        ).metrics_as_built.relative_error
        for robot, drive in ((model, DRIVE), (effects.model, effects.drive))
    )
    assert none > 0.04
    assert auto < 0.0284


@pytest.mark.study
def test_a_study_has_what_it_finds_in_the_model_or_only_names_it(shared) -> None:
    model = load_robot(shared / "models/kuka_lwr4.urdf")
    logs = [
        read_recordings([shared / f"data/kuka_lwr4/measurements_{number}.npz"], model=model)[0]
        for number in (1, 3)
    ]
    errors = {}
    for choice in ("auto", "find", "none"):
        study = identify(model, logs[:1], validation=logs[1:], options=StudyOptions(effects=choice))
        errors[choice] = study.validations[0].metrics_as_built.relative_error
        assert any(each.in_model for each in study.effects) == (choice == "auto")
        assert bool(study.effects) == (choice != "none")
        codes = {finding.code for finding in study.findings}
        assert ("effect_found" in codes) == (choice == "find")
    assert errors["auto"] < 0.8 * errors["none"]
    assert errors["find"] == errors["none"]
