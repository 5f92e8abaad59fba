"""Springs and cylinders of a description, against MuJoCo's tendons."""

from __future__ import annotations

from dataclasses import replace
from xml.etree.ElementTree import SubElement, fromstring, tostring

import numpy as np
import pytest

from asbuilt import identify
from asbuilt.description.formats.toml import robot_from_toml
from asbuilt.description.structure.springs import Spring, with_springs
from asbuilt.dynamics import described_drive, drive_torque, find_base_parameters
from asbuilt.errors import DescriptionError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, check_recording
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.writers.models.mjcf import export_mjcf, note_mjcf_limits
from asbuilt.writers.models.robot_toml import format_robot_toml

mujoco = pytest.importorskip("mujoco")
mujoco_oracle = pytest.importorskip("mujoco_oracle")

LINKS = """
name = "arm"
root_link = "base"
angle_unit = "deg"

[[links]]
name = "upper"
joint = "shoulder"
parent = "base"
origin = { xyz = [0.1, 0, 0.3], rpy = [20, -35, 50] }
axis = [0, 1, 0]
after = { xyz = [0.02, 0.03, 0.04], rpy = [10, 20, 30] }
mass = 5
com = [0.1, 0, 0.1]
inertia_about_com = { Ixx = 0.1, Iyy = 0.1, Izz = 0.1 }
limits = { lower = -100, upper = 100, velocity = 200 }

[[links]]
name = "fore"
joint = "elbow"
origin = { xyz = [0.4, 0, 0.1], rpy = [-70, 15, 5] }
axis = [0.6, 0, 0.8]
after = { xyz = [0.01, -0.03, 0.02], rpy = [10, -20, 30] }
mass = 3
com = [0.2, 0, 0.1]
inertia_about_com = { Ixx = 0.05, Iyy = 0.05, Izz = 0.05 }
limits = { lower = -100, upper = 100, velocity = 200 }

[[frames]]
name = "bracket"
link = "upper"
xyz = [0.05, -0.1, 0.3]
"""
SPRINGS = """
[[springs]]
name = "main"
link_a = "base"
point_a = [0.2, 0.15, 0.5]
link_b = "upper"
point_b = [0.25, -0.1, 0.05]
free_length = 0.1
stiffness = 800

[[springs]]
kind = "torsion"
joint = "elbow"
rest = 30
stiffness = 12

[[springs]]
kind = "cylinder"
link_a = "fore"
point_a = [0.1, 0.05, 0.05]
link_b = "bracket"
free_length = 0.6
force = 150
progression = 6
point_b = [0, 0, 0]
"""


def sprung():
    return robot_from_toml(LINKS + SPRINGS)


def by_hand():
    """Return the arm with tendons between the points as they are stated, in MuJoCo."""
    root = fromstring(export_mjcf(robot_from_toml(LINKS)))
    bodies = {body.get("name"): body for body in root.iter("body")}
    bodies["base"] = root.find("worldbody")
    for name, body, place in (
        ("a", "base", "0.2 0.15 0.5"),
        ("b", "upper", "0.25 -0.1 0.05"),
        ("c", "fore", "0.1 0.05 0.05"),
        ("d", "upper", "0.05 -0.1 0.3"),
    ):
        SubElement(bodies[body], "site", name=name, pos=place)
    tendons = SubElement(root, "tendon")
    for ends, stiffness, length in (("ab", 800.0, 0.1), ("cd", 900.0, 0.6 + 150.0 / 900.0)):
        tendon = SubElement(tendons, "spatial", stiffness=str(stiffness), springlength=repr(length))
        for end in ends:
            SubElement(tendon, "site", site=end)
    elbow = next(each for each in root.iter("joint") if each.get("name") == "elbow")
    elbow.attrib.update(stiffness="12", springref=repr(np.deg2rad(30.0).item()))
    return mujoco.MjModel.from_xml_string(tostring(root, encoding="unicode"))


def spring_torque(compiled, q):
    data, torque = mujoco.MjData(compiled), np.empty(q.shape)
    for k, at in enumerate(q):
        data.qpos[:] = at
        mujoco.mj_forward(compiled, data)
        torque[k] = -data.qfrc_spring
    return torque


def test_torque_is_that_of_tendons_between_the_stated_points():
    model, q = sprung(), np.random.default_rng(0).uniform(-1.7, 1.7, (50, 2))
    drive, values = described_drive(model)
    torque = drive_torque(drive, values, q, np.zeros_like(q), np.zeros_like(q))
    expected = spring_torque(by_hand(), q)
    assert np.abs(torque - expected).max() < 1e-6 * np.abs(expected).max()
    exported = spring_torque(mujoco.MjModel.from_xml_string(export_mjcf(model)), q)
    np.testing.assert_allclose(exported, expected, atol=1e-9)


def test_robot_file_and_virtual_robots_keep_springs():
    model, q = sprung(), np.random.default_rng(1).uniform(-1.0, 1.0, (5, 2))
    again = robot_from_toml(format_robot_toml(model))
    assert [joint.drive.terms for joint in again.joints] == [
        joint.drive.terms for joint in model.joints
    ]
    still = np.zeros_like(q)
    bare, moved = (
        mujoco_oracle.inverse_dynamics(Physics(model, springs=each), q, still, still)
        for each in (False, True)
    )
    np.testing.assert_allclose(moved - bare, spring_torque(by_hand(), q), atol=1e-8)


@pytest.fixture(scope="module")
def log():
    compiled, model = by_hand(), sprung()
    data, rng = mujoco.MjData(compiled), np.random.default_rng(3)
    motion = random_fourier(model, rng=1, duration=20.0).sample(200.0)
    tau = np.empty(motion.q.shape)
    for k, row in enumerate(zip(motion.q, motion.qd, motion.qdd, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(compiled, data)
        tau[k] = data.qfrc_inverse
    return Recording(
        t=motion.t,
        q=motion.q + 1e-5 * rng.normal(size=tau.shape),
        tau=tau + 0.2 * rng.normal(size=tau.shape),
        joint_names=model.joint_names,
        torque_source="sensor",
    )


def unknown():
    known = ("stiffness", "force")
    return robot_from_toml(
        "\n".join(line for line in (LINKS + SPRINGS).splitlines() if not line.startswith(known))
    )


def test_unknown_stiffness_is_identified_and_misleads_no_check(log):
    assert "error" not in {each.severity for each in check_recording(unknown(), log).findings}
    study = identify(unknown(), log, method="wls")
    truth = {"Ke1": 800.0, "Ks2": 12.0, "Pc2": 150.0}
    found = {each.name: each for each in study.result.parameters if each.name in truth}
    assert set(found) == set(truth)
    for name, value in truth.items():
        assert abs(found[name].estimate - value) < 3.0 * found[name].std_error, name
    assert found["Ke1"].std_error < 0.005 * 800.0
    assert "spring_or_mass" not in {each.code for each in study.findings if each.joint != "elbow"}


def test_a_spring_and_masses_of_a_narrow_motion_are_reported_together(log):
    t, compiled = log.t, by_hand()
    w = 2.0 * np.pi * np.array([0.3, 0.35])
    q, data = 0.15 * np.sin(np.outer(t, w)) + 0.03 * np.sin(np.outer(t, 2.7 * w)), None
    qd, data = np.gradient(q, t, axis=0), mujoco.MjData(compiled)
    qdd, tau = np.gradient(qd, t, axis=0), np.empty(q.shape)
    for k, row in enumerate(zip(q, qd, qdd, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(compiled, data)
        tau[k] = data.qfrc_inverse
    noise = np.random.default_rng(3).normal(size=(2, *q.shape))
    narrow = replace(log, q=q + 1e-5 * noise[0], tau=tau + 0.2 * noise[1])
    found = identify(unknown(), narrow, method="wls").findings
    together = [each for each in found if each.code == "spring_or_mass"]
    assert any("Ke1" in each.message and "my1" in each.message for each in together)


def test_a_spring_without_free_length_is_grouped_with_a_mass_where_gravity_is_fixed():
    flat = robot_from_toml(LINKS.replace("rpy = [20, -35, 50]", "rpy = [0, 0, 0]"))
    ends = {"point_a": np.array([0.2, 0.1, 0.5]), "point_b": np.array([0.3, -0.1, 0.1])}
    spring = Spring(link_a="base", link_b="upper", **ends)
    numbers = [
        find_base_parameters(each, described_drive(each)[0]).n_base
        for each in (flat, *(with_springs(flat, [replace(spring, free_length=x)]) for x in (0, 1)))
    ]
    assert numbers[1:] == [numbers[0], numbers[0] + 1]
    known = with_springs(flat, [replace(spring, stiffness=500.0)])
    (drive, values), q = described_drive(known), np.array([[0.3, 0.0], [-1.2, 0.5]])
    frame = flat.joints[0]
    length = [
        np.linalg.norm(
            (frame.before @ frame.moved(at) @ frame.after @ [*ends["point_b"], 1.0])[:3]
            - ends["point_a"]
        )
        for at in (0.3 + 1e-5, 0.3 - 1e-5)
    ]
    energy = 250.0 * np.square(length)
    torque = drive_torque(drive, values, q, 0.0 * q, 0.0 * q)[0, 0]
    assert torque == pytest.approx((energy[0] - energy[1]) / 2e-5, rel=1e-6)


def test_equal_springs_add_up_and_unequal_ones_are_refused():
    model, spring = robot_from_toml(LINKS), {"link_a": "base", "link_b": "upper"}
    ends = {"point_a": np.array([0.2, 0.1, 0.5]), "point_b": np.array([0.3, -0.1, 0.1])}
    one = Spring(**spring, **ends, free_length=0.1, stiffness=300.0)
    two = with_springs(model, [one, one])
    assert two.joints[0].drive.terms["extension_spring"]["Ke"] == 600.0
    with pytest.raises(DescriptionError, match="second extension spring at joint 'shoulder'"):
        with_springs(model, [one, replace(one, free_length=0.2)])


def test_cylinder_of_constant_force_is_named_in_the_notes_of_mjcf():
    model = robot_from_toml(LINKS + SPRINGS.replace("progression = 6\n", ""))
    assert any("elbow 150" in note for note in note_mjcf_limits(model))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('link_b = "upper"', 'link_b = "uper"', "'main'.*no link 'uper'; it has base, upper, fore"),
        ("stiffness = 800", "stiffness = -5", r"springs\[1\] 'main'.stiffness:.*got -5"),
        ('link_b = "upper"', 'link_b = "base"', "both ends of .*'main' are on 'base'"),
        ('link_b = "upper"', 'link_b = "fore"', "'main' spans more than one joint"),
        ("free_length = 0.1\n", "", "free_length: is missing for kind extension"),
        ('joint = "elbow"', 'joint = "wrist"', "names joint 'wrist'; .* shoulder, elbow"),
        ("force = 150", "pull = 150", r"springs\[3\].pull: is not a field"),
        ("rest = 30", "free_length = 0.3", "of kind torsion takes no free_length"),
    ],
)
def test_wrong_springs_are_refused_with_place_and_value(old, new, complaint):
    with pytest.raises(DescriptionError, match=complaint):
        robot_from_toml(LINKS + SPRINGS.replace(old, new, 1))


def test_ends_on_the_axis_or_in_one_place_are_refused():
    model = robot_from_toml(LINKS)
    on_axis = {"link_a": "base", "point_a": np.array([0.1, 0.0, 0.3]), "link_b": "upper"}
    with pytest.raises(DescriptionError, match="on the axis of joint 'shoulder'"):
        with_springs(model, [Spring(**on_axis, point_b=np.array([0.2, 0.0, 0.0]))])
    frame = model.joints[0].before @ model.joints[0].after
    point = np.array([0.2, 0.1, 0.1])
    meeting = {"point_a": frame[:3, :3] @ point + frame[:3, 3], "point_b": point}
    with pytest.raises(DescriptionError, match=r"coincide at position -?0.000 of joint 'shoulder'"):
        with_springs(model, [Spring(**on_axis | meeting)])
