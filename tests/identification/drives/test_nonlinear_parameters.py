"""Nonlinear parameters of drive terms and their choice.

On simulated drives whose friction is known, and on recordings of real ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import (
    DHRow,
    DriveValues,
    JointLimits,
    LinkInertia,
    bundled_robot,
    load_robot,
    robot_from_dh,
)
from asbuilt.dynamics import DriveSet, drive_torque, inverse_dynamics
from asbuilt.dynamics.drives.torque import choose_usual_drive
from asbuilt.errors import DescriptionError, IdentifiabilityError, UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples, SignalChain, hold_out, prepare_samples, read_recordings
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter
from asbuilt.identification import (
    IdentificationResult,
    identify_samples,
    motor_side_parameters,
    settle_drive,
)
from asbuilt.identification.drives.nonlinear_parameters import fit_nonlinear
from asbuilt.validation import validate_samples

PLAIN = DriveSet.parse("viscous,coulomb,offset")


def elbow(**changes):
    rng = np.random.default_rng(7)
    rows = []
    for k, (a, alpha, b) in enumerate([(0.0, np.pi / 2, 0.3), (0.4, 0.0, 0.0), (0.3, 0.0, 0.0)]):
        square = rng.normal(size=(3, 3)) * 0.05
        inertia = LinkInertia.from_com(
            6.0 / (k + 1),
            rng.uniform(-0.1, 0.1, 3),
            np.trace(square @ square.T) * np.eye(3) - square @ square.T,
        )
        rows.append(DHRow(a=a, alpha=alpha, b=b, inertia=inertia))
    robot = robot_from_dh(rows, name="elbow")
    joints = tuple(replace(joint, limits=JointLimits(velocity=3.0)) for joint in robot.joints)
    return replace(robot, **({"joints": joints} | changes))


def recorded(model, drive, values, *, seed=1, noise=0.02, duration=40.0, source="sensor"):
    trajectory = random_fourier(model, seed, duration=duration).sample(100.0)
    state = (trajectory.q, trajectory.qd, trajectory.qdd)
    rigid = inverse_dynamics(model, *state)
    tau = rigid + drive_torque(drive, values, *state, load=rigid, shares=model.motor_shares)
    tau = tau + noise * np.random.default_rng(seed).normal(size=tau.shape)
    return Samples(
        trajectory.t, *state, tau, rate=100.0, joint_names=model.joint_names, torque_source=source
    )


def test_a_stribeck_velocity_comes_back_joint_by_joint():
    model = elbow()
    truth = DriveSet.parse("viscous,coulomb,stribeck:velocity=0.05/0.1/0.2,offset")
    samples = recorded(model, truth, np.tile([0.5, 1.0, 1.5, 0.2], 3))
    found = fit_nonlinear(model, DriveSet.parse("viscous,coulomb,stribeck,offset"), [samples])
    assert found.drive.is_linear
    np.testing.assert_allclose(found.nonlinear[0].values, [0.05, 0.1, 0.2], rtol=0.1)
    assert np.all(found.nonlinear[0].determined)
    assert "fitted by variable projection" in found.sentences(model.joint_names)[0]


@pytest.mark.study
def test_two_nonlinear_parameters_come_back_together():
    model = elbow()
    truth = DriveSet.parse("smooth_coulomb:width=0.1,power:exponent=1.8,offset")
    samples = recorded(model, truth, np.tile([2.0, 0.5, 0.2], 3), noise=0.005)
    found = fit_nonlinear(model, DriveSet.parse("smooth_coulomb,power,offset"), [samples])
    values = {parameter.term: parameter.values for parameter in found.nonlinear}
    np.testing.assert_allclose(values["smooth_coulomb"], 0.1, rtol=0.1)
    np.testing.assert_allclose(values["power"], 1.8, rtol=0.1)


def test_a_nonlinear_parameter_that_the_data_do_not_tell_keeps_its_default():
    model = elbow()
    samples = recorded(model, PLAIN, np.tile([0.5, 1.0, 0.2], 3))
    found = fit_nonlinear(model, PLAIN.with_term(DriveSet.parse("stribeck").terms[0]), [samples])
    assert not found.nonlinear[0].determined.any()
    assert found.nonlinear[0].values == (0.1, 0.1, 0.1)
    judged = settle_drive(model, [samples], DriveSet.parse("viscous,coulomb,stribeck,offset"))
    assert any("held-out blocks" in sentence for sentence in judged.sentences)


def test_load_friction_is_found_with_its_own_load_whatever_cad_says():
    model = elbow()
    drive = DriveSet.parse("viscous,coulomb,load_friction,offset")
    samples = recorded(model, drive, np.tile([0.5, 1.0, 0.1, 0.2], 3))
    wrong = model.with_parameters(0.5 * model.parameters)
    result = identify_samples(wrong, samples, drive=drive)
    found = {parameter.name: parameter.estimate for parameter in result.parameters}
    np.testing.assert_allclose([found[f"Fl{k}"] for k in (1, 2, 3)], 0.1, atol=0.005)
    np.testing.assert_allclose(result.train.rms, 0.02, rtol=0.1)
    stored = IdentificationResult.from_json(result.to_json())
    np.testing.assert_array_equal(
        stored.predict(samples).predicted, result.predict(samples).predicted
    )


def test_a_coupled_wrist_comes_back():
    coupling = np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 1]])
    model = elbow(motor_coupling=coupling, gravity=np.array([0.0, 0.0, -9.81]))
    drive = DriveSet.parse("armature,viscous,coulomb,motor_viscous,motor_coulomb,offset")
    values = np.tile([0.1, 0.5, 0.3, 1.0, 0.7, 0.2], 3)
    samples = recorded(model, drive, values, noise=0.005)
    result = identify_samples(model, samples, drive=drive)
    found = {parameter.name: parameter.estimate for parameter in result.parameters}
    assert found["Fvm3"] == pytest.approx(0.3, abs=0.01)
    assert found["Fcm3"] == pytest.approx(0.7, abs=0.01)
    assert "Fvm2" not in found
    np.testing.assert_allclose(result.train.rms, 0.005, rtol=0.1)
    stored = IdentificationResult.from_json(result.to_json())
    np.testing.assert_array_equal(stored.model.motor_coupling, coupling)
    np.testing.assert_array_equal(
        stored.predict(samples).predicted, result.predict(samples).predicted
    )


@pytest.mark.parametrize("scale", [1.0, 0.0])
def test_nothing_is_chosen_where_the_defaults_leave_nothing(scale):
    """Torque without noise, or none at all.

    Held-out errors are rounding, whose logarithms must not decide, nor be of numbers below zero.
    """
    model = elbow()
    samples = recorded(model, PLAIN, np.tile([0.5, 1.0, 0.2], 3), noise=0.0)
    samples = replace(samples, tau=scale * samples.tau, tau_raw=np.empty((0, 0)))
    with np.errstate(divide="raise", invalid="raise"):
        assert settle_drive(model, [samples], "auto").drive == PLAIN


@pytest.mark.parametrize("key", ["stribeck", "power"])
def test_a_recording_shorter_than_the_filter_determines_no_nonlinear_parameters(key):
    model, drive = elbow(), DriveSet.parse(f"coulomb,{key},offset")
    few = replace(
        recorded(model, PLAIN, np.tile([0.5, 1.0, 0.2], 3), duration=0.5),
        parallel=design_parallel_filter(2.0, 100.0, 4),
    )
    assert few.n_filtered == 0
    with pytest.raises(
        IdentifiabilityError,
        match=(
            rf"are left to fit the nonlinear parameters of coulomb,{key},offset: .* or state the"
            r" nonlinear parameters"
        ),
    ):
        settle_drive(model, [few], drive)


@pytest.mark.study
@pytest.mark.parametrize(("velocity", "at_bound"), [(0.4, True), (0.7, False)])
def test_what_fades_at_speed_is_no_stribeck_friction(velocity, at_bound):
    model = elbow()
    asked = DriveSet.parse("viscous,coulomb,stribeck,offset")
    truth = DriveSet.parse(f"viscous,coulomb,stribeck:velocity={velocity},offset")
    samples = recorded(model, truth, np.tile([0.5, 1.0, 1.5, 0.2], 3))
    found = fit_nonlinear(model, asked, [samples]).nonlinear[0]
    assert not found.determined.any()
    assert found.at_bound.all() == at_bound
    np.testing.assert_allclose(found.highest, 0.3)
    findings = settle_drive(model, [samples], asked).findings
    assert any("friction there is of another kind" in each.message for each in findings) == at_bound
    assert "stribeck" not in settle_drive(model, [samples], "auto").drive.keys


def test_the_choice_finds_what_was_put_in_and_where():
    model = elbow(gravity=np.array([0.0, 4.0, -9.0]))
    truth = DriveSet.parse(
        "viscous,coulomb,load_friction:joints=2,stribeck:joints=1/3:velocity=0.1,offset"
    )
    values = np.tile([0.5, 1.0, 2.0, 0.2, 0.2], 3)
    choice = settle_drive(model, [recorded(model, truth, values, noise=0.05)], "auto")
    assert {
        str(replace(term, **{parameter.name: None for parameter in term.nonlinear}))
        for term in choice.drive.terms
    } == {
        "viscous",
        "coulomb",
        "load_friction:joints=2",
        "stribeck:joints=1/3",
        "offset",
    }
    stribeck = next(term for term in choice.drive.terms if term.key == "stribeck")
    np.testing.assert_allclose([stribeck.at(k).value("velocity") for k in (0, 2)], 0.1, rtol=0.1)
    judged = recorded(model, truth, values, noise=0.05, seed=5)
    errors = [
        validate_samples(
            identify_samples(model, recorded(model, truth, values, noise=0.05), drive=drive), judged
        ).metrics_as_built.rms
        for drive in (PLAIN, choice.drive)
    ]
    assert np.all(errors[1] < errors[0])
    np.testing.assert_allclose(errors[1], 0.05, rtol=0.15)


def test_viscous_friction_gives_way_to_a_power_of_speed():
    model = elbow()
    truth = DriveSet.parse("power:exponent=0.6,coulomb,offset")
    choice = settle_drive(model, [recorded(model, truth, np.tile([1.0, 2.0, 0.2], 3))], "auto")
    assert choice.drive.keys == ("coulomb", "power", "offset")
    power = next(term for term in choice.drive.terms if term.key == "power")
    np.testing.assert_allclose([power.at(k).value("exponent") for k in range(3)], 0.6, atol=0.06)


def test_springs_are_for_those_who_ask():
    model = elbow()
    truth = DriveSet.parse("viscous,coulomb,spring:joints=2,offset")
    samples = recorded(model, truth, np.tile([0.5, 1.0, 0.2, 3.0], 3), noise=0.05)
    assert "spring" not in settle_drive(model, [samples], "auto").drive.keys
    asked = settle_drive(model, [samples], "auto,spring:joints=2")
    assert asked.drive == DriveSet.parse("viscous,coulomb,spring:joints=2,offset")
    grease = recorded(
        model, DriveSet.parse("power:exponent=0.6,coulomb,offset"), np.tile([1.0, 2.0, 0.2], 3)
    )
    stated = settle_drive(model, [grease], "auto,stribeck:velocity=0.05").drive
    assert {"power", "stribeck"} <= set(stated.keys)
    assert "stribeck:velocity=0.05" in stated.specifications
    with pytest.raises(UsageError, match="did you mean 'spring'"):
        settle_drive(model, [samples], "auto,sprang")
    with pytest.raises(UsageError, match="do not leave a choice"):
        settle_drive(model, [samples], "viscous")


@pytest.mark.parametrize("seed", range(4))
def test_friction_that_drives_is_not_believed(seed):
    """Where speed sheds friction of the wrong sign, as an unmodelled effect would, no candidate
    takes it in.
    """
    model = elbow()
    truth = DriveSet.parse("viscous,coulomb,load_friction,offset")
    choice = settle_drive(
        model, [recorded(model, truth, np.tile([0.5, 1.0, -0.05, 0.2], 3), seed=seed)], "auto"
    )
    assert "load_friction" not in choice.drive.keys


@pytest.mark.parametrize("robot", ["ur10e"])
@pytest.mark.study
def test_friction_under_load_is_found_on_whole_arms(robot):
    model = bundled_robot(robot)
    truth = DriveSet.parse("viscous,coulomb,load_friction,offset")
    values = np.tile([0.5, 1.0, 0.15, 0.1], model.n_joints)
    train, judged = (recorded(model, truth, values, duration=40.0, seed=seed) for seed in (2, 5))
    choice = settle_drive(model, [train], "auto")
    assert choice.drive.keys == truth.keys
    np.testing.assert_allclose(
        validate_samples(
            identify_samples(model, train, drive=choice.drive), judged
        ).metrics_as_built.rms,
        0.02,
        rtol=0.3,
    )


def test_the_defaults_stay_where_nothing_else_is_there():
    model = elbow()
    samples = recorded(model, PLAIN, np.tile([0.5, 1.0, 0.2], 3), noise=0.05)
    choice = settle_drive(model, [samples], "auto")
    assert choice.drive == PLAIN
    short = settle_drive(model, [samples.between(0.0, 2.5)], "auto")
    assert short.drive == PLAIN


def test_parameters_at_the_motor():
    model = elbow()
    ratio = replace(
        model,
        joints=tuple(replace(joint, drive=DriveValues(gear_ratio=100.0)) for joint in model.joints),
    )
    drive = DriveSet.parse("armature,viscous,coulomb,power:exponent=1.5,offset")
    result = identify_samples(
        ratio, recorded(ratio, drive, np.tile([0.5, 1.0, 2.0, 0.3, 0.2], 3)), drive=drive
    )
    found = {each.name: each.motor_side / each.joint_side for each in motor_side_parameters(result)}
    assert found["Fv2"] == pytest.approx(1e-4)
    assert found["Fc2"] == pytest.approx(1e-2)
    assert found["Fp2"] == pytest.approx(1e-5)
    assert found["Fo2"] == pytest.approx(1e-2)
    turned = replace(
        model,
        joints=tuple(
            replace(joint, drive=DriveValues(gear_ratio=-100.0)) for joint in model.joints
        ),
    )
    drive = DriveSet.parse("viscous,spring,balancer,offset")
    values = np.tile([1.0, 3.0, 0.4, 0.5, 0.0, 0.0, 0.2], 3)
    result = identify_samples(turned, recorded(turned, drive, values), drive=drive)
    found = {each.name: each.motor_side / each.joint_side for each in motor_side_parameters(result)}
    assert {name[:2]: np.sign(ratio) for name, ratio in found.items()} == {
        "Fv": 1.0,
        "Ks": 1.0,
        "Bs": -1.0,
        "Bc": -1.0,
        "Fo": -1.0,
    }
    with pytest.raises(DescriptionError, match="gear_ratio"):
        motor_side_parameters(
            identify_samples(model, recorded(model, PLAIN, np.ones(9)), drive=PLAIN)
        )


@pytest.mark.study
def test_load_friction_pays_on_a_recorded_ur10e(shared, tmp_path):
    sheet = tmp_path / "sheet.toml"
    sheet.write_text(
        'header = false\ntorque_source = "current"\n[columns]\ntime = 1\nposition = "2-7"\nvelocity'
        ' = "8-13"\ntorque = "14-19"\n'
    )
    model = load_robot(str(shared / "models" / "ur10e.urdf"))
    logs = [
        shared / "data" / "ur10e" / name
        for name in ("ur-20_02_10-30sec_12harm.csv", "ur-20_02_12-40sec_12harm.csv")
    ]
    gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]
    train, judged = (
        prepare_samples(
            read_recordings([log], model=model, sheet=sheet, gain=gains)[0], SignalChain(cutoff=4.0)
        )
        for log in logs
    )
    choice = settle_drive(model, [train], "auto")
    assert "load_friction" in choice.drive.keys
    assert not {"spring", "balancer", "cubic"} & set(choice.drive.keys)
    plain, rich = (
        validate_samples(identify_samples(model, train, drive=drive), judged).metrics_as_built.rms
        for drive in (DriveSet.default("current"), choice.drive)
    )
    assert np.exp(np.mean(np.log(rich / plain))) < 0.85
    assert np.all(rich[1:3] < 0.75 * plain[1:3])


def test_a_recorded_med7_keeps_its_defaults(shared):
    """Its sensors see no gears, and what is left of the torque is the mounting, which no friction
    is.
    """
    model = load_robot(str(shared / "models" / "lbrstack_med7.urdf"))
    log = shared / "data" / "lbr_med7" / "measurements_with_ext_tau_1_dgr.csv"
    samples = prepare_samples(read_recordings([log], model=model, rate=100.0, flip_torque=True)[0])
    train, _ = hold_out(samples, "blocks:5s:3")
    assert settle_drive(model, [train], "auto").drive == PLAIN


def test_what_a_robot_was_built_with_is_among_its_usual_terms():
    model = elbow()
    sprung = replace(
        model.joints[1], drive=DriveValues(terms={"spring": {"Ks": 3.0}, "stribeck": {"Fs": 0.3}})
    )
    built = replace(model, joints=(model.joints[0], sprung, model.joints[2]))
    own = DriveSet.parse("viscous,coulomb,spring:joints=2:rest=0,offset")
    assert choose_usual_drive(built, "sensor") == own
    wrist = replace(model, motor_coupling=np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 1]]))
    assert set(choose_usual_drive(wrist, "motor").specifications) - set(
        choose_usual_drive(model, "motor").specifications
    ) == {
        "motor_armature:joints=3",
        "motor_viscous:joints=3",
        "motor_coulomb:joints=3",
    }
    assert choose_usual_drive(wrist, "sensor") == PLAIN
    samples = recorded(
        built,
        DriveSet.parse("viscous,coulomb,spring:joints=2,offset"),
        np.tile([0.5, 1.0, 0.2, 3.0], 3),
        noise=0.05,
    )
    assert (
        settle_drive(built, [samples]).drive
        == settle_drive(built, [samples], "auto").drive
        == choose_usual_drive(built, "sensor")
    )


def test_bundled_robots_accept_every_default():
    model = bundled_robot("kuka-iiwa7-r800")
    samples = recorded(model, PLAIN, np.tile([0.5, 1.0, 0.2], 7), duration=10.0)
    assert settle_drive(model, [samples], None).drive == PLAIN
    assert settle_drive(
        model, [replace(samples, torque_source="motor")], None
    ).drive == DriveSet.default("motor")
