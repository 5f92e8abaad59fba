"""Two encoders of elastic drives, with truth from MuJoCo: a joint per side, a spring between."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree.ElementTree import fromstring, tostring

import numpy as np
import pytest

from asbuilt import identify
from asbuilt.description import load_robot
from asbuilt.description.formats.toml import robot_from_toml
from asbuilt.dynamics import gravity_torque, inverse_dynamics, mass_matrix
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, read_recording
from asbuilt.experiment.signal.preparation import MotionFilters
from asbuilt.identification.calibration.encoders import identify_encoders
from asbuilt.identification.effects.families.elastic import OFF, rigid_limit
from asbuilt.workflow import Study
from asbuilt.writers import export_result, report_html
from asbuilt.writers.models.mjcf import export_mjcf

mujoco = pytest.importorskip("mujoco")

ARM = """
name = "arm"
root_link = "base"

[[links]]
name = "turret"
joint = "j1"
parent = "base"
origin = { xyz = [0, 0, 0.3] }
axis = [0, 0, 1]
mass = 5
com = [0.05, 0, 0.1]
inertia_about_com = { Ixx = 0.1, Iyy = 0.1, Izz = 0.1 }
limits = { lower = -2.5, upper = 2.5, velocity = 2.5 }
drive = { armature = 0.8 }

[[links]]
name = "upper"
joint = "j2"
origin = { xyz = [0.1, 0, 0.1] }
axis = [0, 1, 0]
mass = 4
com = [0.25, 0.02, 0]
inertia_about_com = { Ixx = 0.02, Iyy = 0.06, Izz = 0.06 }
limits = { lower = -2, upper = 2, velocity = 2.5 }
drive = { armature = 1.0 }

[[links]]
name = "fore"
joint = "j3"
origin = { xyz = [0.5, 0, 0] }
axis = [0, 1, 0]
mass = 2
com = [0.2, 0, 0.03]
inertia_about_com = { Ixx = 0.01, Iyy = 0.02, Izz = 0.02 }
limits = { lower = -2, upper = 2, velocity = 2.5 }
drive = { armature = 0.4 }
"""
MODEL = robot_from_toml(ARM)
ROTORS = np.array([0.8, 1.0, 0.4])
VISCOUS, DRY = np.array([2.0, 3.0, 1.0]), np.array([3.0, 4.0, 2.0])
LAG, ZERO = 0.003, 0.1
BREAKAWAY = 0.02


def stiffness(frequencies):
    """Return stiffness [N m/rad] whose link would swing at frequencies [Hz] with the motor held."""
    rng = np.random.default_rng(0)
    masses = mass_matrix(MODEL, rng.uniform(-1.0, 1.0, (20, 3)))
    inertia = np.mean(np.diagonal(masses, axis1=1, axis2=2), axis=0)
    return inertia, inertia * (2.0 * np.pi * np.array(frequencies)) ** 2


def two_masses(K, D):
    root = fromstring(export_mjcf(MODEL))
    for body in root.iter("body"):
        for joint in body.findall("joint"):
            k = MODEL.joint_names.index(joint.get("name"))
            for name in ("range", "damping", "frictionloss"):
                joint.attrib.pop(name, None)
            link = deepcopy(joint)
            link.attrib.pop("armature")
            link.attrib.update(name=f"link {k}", stiffness=str(K[k]), damping=str(D[k]))
            body.insert(list(body).index(joint) + 1, link)
    return mujoco.MjModel.from_xml_string(tostring(root, encoding="unicode"))


@cache
def log(frequencies, seed, *, play=0.0, step=5e-4, duration=20.0):
    """Return truth, and the recording of an arm under a controller of its motors."""
    inertia, K = stiffness(frequencies)
    D = 2.0 * 0.02 * np.sqrt(K * inertia)
    compiled = two_masses(K, D)
    data, rng = mujoco.MjData(compiled), np.random.default_rng(seed)
    compiled.opt.timestep = step
    compiled.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    goal = random_fourier(MODEL, rng=seed, duration=duration).sample(1.0 / step)
    forward = inverse_dynamics(MODEL, goal.q, goal.qd, goal.qdd)
    forward = forward + ROTORS * goal.qdd + VISCOUS * goal.qd + DRY * np.tanh(goal.qd / BREAKAWAY)
    pole, motors, twists = 4.0 * np.pi, slice(0, None, 2), slice(1, None, 2)
    data.qpos[motors] = goal.q[0]
    data.qpos[twists] = -gravity_torque(MODEL, goal.q[0]) / K
    theta, q, tau = np.empty((3, *goal.q.shape))
    for k in range(len(tau)):
        at, speed = data.qpos[motors].copy(), data.qvel[motors].copy()
        theta[k], q[k] = at, at + data.qpos[twists]
        tau[k] = forward[k] + (ROTORS + 0.3) * (
            pole**2 * (goal.q[k] - at) + 2.0 * pole * (goal.qd[k] - speed)
        )
        data.qfrc_applied[motors] = tau[k] - VISCOUS * speed - DRY * np.tanh(speed / BREAKAWAY)
        mujoco.mj_step(compiled, data)
    speed = np.gradient(theta, step, axis=0)
    late = [np.interp(goal.t - LAG, goal.t, column) for column in q.T]
    second = np.stack(late, axis=1) - 0.5 * play * np.tanh(speed / BREAKAWAY) + ZERO
    every = slice(0, None, round(0.002 / step))
    noise = rng.normal(size=(3, *theta[every].shape))
    return K, Recording(
        t=goal.t[every],
        q=theta[every] + 5e-6 * noise[0],
        tau=tau[every] + 0.01 * tau.std(axis=0) * noise[1],
        extra={"q_link": second[every] + 5e-6 * noise[2]},
        joint_names=MODEL.joint_names,
        torque_source="motor",
    )


def samples_of(recording):
    return MotionFilters().prepare(recording).samples()


def true_friction(samples):
    return VISCOUS * samples.qd + DRY * np.tanh(samples.qd / BREAKAWAY)


@pytest.mark.parametrize(
    ("frequencies", "seed"),
    [
        ((12.0, 20.0, 8.0), 2),
        pytest.param((5.0, 5.0, 5.0), 1, marks=pytest.mark.study),
        pytest.param((40.0, 30.0, 40.0), 3, marks=pytest.mark.study),
    ],
)
def test_stiffness_lag_and_rotor_are_those_of_two_masses(frequencies, seed):
    K, recording = log(frequencies, seed)
    samples = samples_of(recording)
    pairs = identify_encoders([samples], [True] * 3, [true_friction(samples)])
    assert [each.joint for each in pairs] == list(MODEL.joint_names)
    for pair, own, rotor in zip(pairs, K, ROTORS, strict=True):
        if pair.stiffness is not None:
            value, error = pair.stiffness
            assert abs(value - own) < max(0.05 * own, 3.0 * error)
            assert abs(pair.rotor - rotor) < max(0.05 * rotor, 4.0 * pair.rotor_error)
        assert abs(pair.lag - LAG) < max(2e-5, 4.0 * pair.lag_error)
    assert sum(each.stiffness is not None for each in pairs) >= 2


def test_encoders_with_play_show_their_hysteresis():
    _, recording = log((20.0, 20.0, 20.0), 4, play=2e-4)
    samples = samples_of(recording)
    for pair in identify_encoders([samples], [True] * 3, [true_friction(samples)]):
        assert abs(pair.hysteresis - 2e-4) < max(1e-5, 4.0 * pair.hysteresis_error)


def test_an_encoder_of_another_coordinate_and_one_that_rests_are_no_pair():
    _, recording = log((5.0, 5.0, 5.0), 1)
    other = recording.extra["q_link"].copy()
    other[:, 0] = 0.0
    other[:, 2] += 0.5 * other[:, 1]
    pairs = identify_encoders([samples_of(replace(recording, extra={"q_link": other}))], [True] * 3)
    assert [each.joint for each in pairs] == ["j2"]
    assert identify_encoders([samples_of(replace(recording, extra={}))], [True] * 3) == ()


def test_direction_zero_and_side_of_the_encoder_do_not_matter():
    _, recording = log((5.0, 5.0, 5.0), 1)
    turned = replace(recording, extra={"q_link": 1.3 - recording.extra["q_link"]})
    swapped = replace(recording, q=recording.extra["q_link"], extra={"q_motor": recording.q})
    first, *others = (
        identify_encoders([samples_of(each)], [True] * 3) for each in (recording, turned, swapped)
    )
    for pairs in others:
        for one, other in zip(first, pairs, strict=True):
            assert one.compliance == pytest.approx(other.compliance, rel=1e-3)
            assert one.lag == pytest.approx(other.lag, abs=1e-5)


@pytest.fixture(scope="module")
def studies():
    _, recording = log((5.0, 5.0, 5.0), 1)
    return [identify(MODEL, each) for each in (replace(recording, extra={}), recording)]


@pytest.mark.study
def test_two_encoders_make_a_better_model_of_an_elastic_arm(studies):
    alone, both = studies
    errors = [study.result.validation[0].relative_error_per_joint for study in studies]
    assert np.all(errors[1][1:] < 0.5 * errors[0][1:])
    assert alone.result.encoders == ()
    viscous = {each.name: each for each in both.result.parameters if each.name.startswith("Fv")}
    for k, own in enumerate(VISCOUS, start=1):
        found = viscous[f"Fv{k}"]
        assert abs(found.estimate - own) < max(0.03 * own, 4.0 * found.std_error)
    for pair, own in zip(both.result.encoders, log((5.0, 5.0, 5.0), 1)[0], strict=True):
        assert pair.stiffness is not None
        assert pair.stiffness[0] == pytest.approx(own, rel=0.05)


@pytest.mark.study
def test_the_armature_that_a_search_finds_is_that_of_the_encoders() -> None:
    recording = replace(log((5.0, 5.0, 5.0), 1)[1], torque_source="unknown")
    bare = tuple(replace(joint, drive=type(joint.drive)()) for joint in MODEL.joints)
    study = identify(replace(MODEL, joints=bare), recording)
    rotors = {pair.joint: (pair.rotor, pair.rotor_error) for pair in study.result.encoders}
    found = [each for each in study.effects if each.effect == "armature"]
    assert len(found) == 3
    for each in found:
        assert (each.estimate, each.std_error) == pytest.approx(rotors[each.joint])
        assert each.feasible is None
        own = ROTORS[MODEL.joint_names.index(each.joint)]
        assert each.estimate == pytest.approx(own, rel=0.01)


@pytest.mark.study
def test_screen_stored_result_and_report_have_the_encoders(studies):
    both = studies[1]
    assert "Two encoders: j1 lag" in str(both.summary())
    assert Study.from_json(both.to_json()).result.encoders == both.result.encoders
    page = report_html(both)
    assert "Two encoders" in page
    assert "hysteresis" in page


@pytest.mark.study
def test_mjcf_with_a_joint_per_side_swings_as_the_arm_does(studies, tmp_path: Path):
    result = studies[1].result
    export_result(result, mjcf=tmp_path / "elastic.xml", elastic=True)
    compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "elastic.xml"))
    _, K = stiffness((5.0, 5.0, 5.0))
    truth = two_masses(K, np.zeros(3))

    def frequencies(model):
        data, M = mujoco.MjData(model), np.zeros((6, 6))
        mujoco.mj_forward(model, data)
        for column, unit in zip(M, np.eye(6), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        own = [k for k in range(6) if "link" in model.joint(k).name]
        values = np.linalg.eigvals(
            np.linalg.solve(M, np.diag([K[k // 2] if k in own else 0.0 for k in range(6)]))
        )
        return np.sort(np.sqrt(np.abs(values.real)))[3:]

    np.testing.assert_allclose(compiled.dof_armature[::2], ROTORS, rtol=0.05)
    np.testing.assert_allclose(frequencies(compiled), frequencies(truth), rtol=0.03)


@pytest.mark.study
def test_elastic_joints_without_stiffness_are_refused(studies, tmp_path: Path):
    with pytest.raises(UsageError, match="no stiffness of a joint"):
        export_result(studies[0].result, mjcf=tmp_path / "arm.xml", elastic=True)
    with pytest.raises(UsageError, match="no such file is named"):
        export_result(studies[1].result, toml=tmp_path / "arm.toml", elastic=True)


def test_the_rigid_model_fails_at_the_stated_share_of_the_torque():
    """A pendulum without gravity whose motor turns as sin(w t): its link's torque is exact."""
    model = robot_from_toml(ARM.split('[[links]]\nname = "upper"', maxsplit=1)[0])
    inertia, K = 0.1 + 5 * 0.05**2, 400.0
    w = 2.0 * np.pi * rigid_limit(model, 0, K)
    amplification = 1.0 / (1.0 - inertia * w**2 / K)
    assert amplification - 1.0 == pytest.approx(OFF / (1.0 - OFF), rel=1e-9)


@pytest.mark.study
def test_encoders_of_a_kr300_are_three_milliseconds_apart(shared: Path) -> None:
    model = load_robot(str(shared / "models/kuka_kr300.toml"))
    sheet = {
        "torque_source": "motor",
        "gains": [256.857143, 267.428571, 252.333333, 221.0, 239.619048, 154.323134],
        "zero": [0.0, 1.5707963267948966, -1.5707963267948966, 0.0, 0.0, 0.0],
    }
    logs = [
        read_recording(shared / "data/kr300" / name, model=model, sheet=sheet)
        for name in ("A.csv", "B.csv")
    ]
    result = identify(model, logs).result
    assert [each.joint for each in result.encoders] == ["joint_1", "joint_2", "joint_3"]
    for each in result.encoders:
        assert each.lag == pytest.approx(3.0e-3, abs=3.0 * each.lag_error)
        assert each.lag_error < 3e-4
