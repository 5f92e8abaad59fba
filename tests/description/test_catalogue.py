from __future__ import annotations

import csv

import numpy as np
import pytest

from asbuilt.description import LinkInertia, bundled_robot, load_robot, robot_names
from asbuilt.description.plausibility import find_inconsistencies
from asbuilt.dynamics import inverse_dynamics, mass_matrix
from asbuilt.errors import DescriptionError

EXPECTED = {
    "dvrk-mtm": 7,
    "dvrk-psm": 7,
    "four-bar": 1,
    "franka-panda": 7,
    "g1-arms": 14,
    "go2": 12,
    "kuka-iiwa7-r800": 7,
    "puma-560": 6,
    "scara": 4,
    "so-101": 5,
    "so-101-gripper": 6,
    "two-link": 2,
    "ur10e": 6,
}
INCONSISTENT = {"puma-560": ("link 1: mass is 0 kg; it must be positive",)}


def test_the_bundled_robots_are_there():
    assert {name: bundled_robot(name).n_joints for name in robot_names()} == EXPECTED


@pytest.mark.parametrize("name", EXPECTED)
def test_every_bundled_robot_is_cited_and_consistent_or_says_why_not(name):
    model = load_robot(name)
    assert model.name == name
    assert len(model.citation) > 40
    assert "\\" not in model.citation
    assert "\n" not in model.citation
    assert model.source == f"bundled robot {name}"
    assert find_inconsistencies(model) == INCONSISTENT.get(name, ())
    if name in INCONSISTENT:
        assert any("no real body has these parameters" in note for note in model.notes)
    assert all(link.inertia_known for link in model.links)
    assert all(joint.limits.lower < joint.limits.upper for joint in model.joints)
    assert all(np.isfinite(joint.limits.torque) for joint in model.joints)


@pytest.mark.parametrize("name", EXPECTED)
def test_every_mass_matrix_is_positive_definite(name):
    model = load_robot(name)
    for q in np.random.default_rng(0).uniform(-2, 2, (5, model.n_joints)):
        assert np.linalg.eigvalsh(mass_matrix(model, q)).min() > 0


def test_the_iiwa_is_table_1_with_the_last_twist_corrected(shared):
    bundled, table = load_robot("kuka-iiwa7-r800"), load_robot(shared / "paper" / "table1.csv")
    assert np.array_equal(bundled.parameters, table.parameters)
    assert (
        dict(bundled.lengths)
        == dict(table.lengths)
        == {
            "b1": 0.34,
            "b3": 0.4,
            "b5": 0.4,
            "b7": 0.126,
        }
    )
    for ours, theirs in zip(bundled.joints[:6], table.joints[:6], strict=True):
        assert np.array_equal(ours.after, theirs.after)
    assert np.array_equal(bundled.joints[6].after[:3, :3], np.eye(3))
    assert not np.array_equal(table.joints[6].after[:3, :3], np.eye(3))
    assert any("alpha of the last row is 90 deg" in note for note in table.notes)
    with (shared / "paper" / "table1.csv").open() as stream:
        for row, link in zip(csv.DictReader(stream), table.links, strict=True):
            numbers = {key: float(value) for key, value in row.items()}
            assert link.inertia.mass == numbers["m"]
            assert np.allclose(
                link.inertia.com, [numbers["rx"], numbers["ry"], numbers["rz"]], rtol=1e-14
            )
            c = [
                [numbers["Ixx"], numbers["Ixy"], numbers["Izx"]],
                [numbers["Ixy"], numbers["Iyy"], numbers["Iyz"]],
                [numbers["Izx"], numbers["Iyz"], numbers["Izz"]],
            ]
            assert np.allclose(link.inertia.inertia_about_com, c, atol=1e-16)


def test_the_smallest_pseudo_inertia_of_table_1_is_as_published():
    smallest = min(
        np.linalg.eigvalsh(link.inertia.pseudo_inertia).min()
        for link in load_robot("kuka-iiwa7-r800").links
    )
    assert f"{smallest:.1e}" == "8.4e-04"


def test_the_ur10e_needs_the_torques_of_the_manufacturers_urdf(shared):
    ours, theirs = load_robot("ur10e"), load_robot(shared / "models" / "ur10e.urdf")
    assert ours.joint_names == theirs.joint_names
    q, qd, qdd = np.random.default_rng(0).uniform(-2, 2, (3, 50, 6))
    assert (
        np.abs(inverse_dynamics(ours, q, qd, qdd) - inverse_dynamics(theirs, q, qd, qdd)).max()
        < 2e-9
    )
    for a, b in zip(ours.joints, theirs.joints, strict=True):
        assert np.isclose(a.limits.velocity, b.limits.velocity)
        assert a.limits.torque == b.limits.torque


def test_the_so_101_needs_the_torques_of_the_makers_file(shared):
    ours = load_robot("so-101")
    theirs = load_robot(shared / "models" / "so101" / "so101_new_calib.xml").locked(
        {"gripper": 0.0}
    )
    assert ours.joint_names == theirs.joint_names
    q, qd, qdd = np.random.default_rng(0).uniform(-2, 2, (3, 50, 5))
    assert np.allclose(
        inverse_dynamics(ours, q, qd, qdd), inverse_dynamics(theirs, q, qd, qdd), atol=1e-7
    )


def test_the_so_101_with_its_gripper_needs_the_torques_of_the_makers_file(shared):
    ours = load_robot("so-101-gripper")
    theirs = load_robot(shared / "models" / "so101" / "so101_new_calib.xml")
    assert ours.joint_names == theirs.joint_names
    q, qd, qdd = np.random.default_rng(0).uniform(-2, 2, (3, 50, 6))
    assert np.allclose(
        inverse_dynamics(ours, q, qd, qdd), inverse_dynamics(theirs, q, qd, qdd), atol=1e-7
    )


def test_the_go2_needs_the_torques_of_the_menagerie(shared):
    ours = load_robot("go2")
    theirs = load_robot(shared / "models" / "go2" / "go2.xml", fixed_base=True)
    assert ours.joint_names == theirs.joint_names
    q, qd, qdd = np.random.default_rng(0).uniform(-2, 2, (3, 50, 12))
    assert np.allclose(
        inverse_dynamics(ours, q, qd, qdd), inverse_dynamics(theirs, q, qd, qdd), atol=1e-6
    )


def test_the_arms_of_the_g1_mirror_each_other():
    """Mirrored at y = 0, rotations about x and z change their sign, those about y do not."""
    from asbuilt.dynamics import gravity_torque

    model = load_robot("g1-arms")
    q = np.random.default_rng(1).uniform(-1, 1, 7)
    signs = np.array([1, -1, -1, 1, -1, 1, -1])
    left, right = np.split(gravity_torque(model, np.concatenate([q, signs * q])), 2)
    assert np.allclose(left, signs * right, atol=2e-6)
    assert np.abs(left).max() > 1.0


def test_the_panda_reproduces_the_coefficients_it_was_retrieved_from():
    """Gaz et al. (2019) publish the identified coefficients.

    Their retrieved parameters meet them within 0.01 kg m.
    """
    link = {i + 1: link.inertia for i, link in enumerate(load_robot("franka-panda").links)}
    m = {i: one.mass for i, one in link.items()}
    h = {i: one.first_moment for i, one in link.items()}
    beyond = {i: sum(m[k] for k in range(i, 8)) for i in range(1, 8)}
    gravity = {
        "c2y": (h[2][1] - 0.316 * beyond[3] - h[3][2], -3.102576),
        "c3x": (0.0825 * beyond[4] + h[3][0], 0.6873555),
        "c4x": (h[4][0] - 0.0825 * beyond[5], -0.4888364),
        "c4y": (0.384 * beyond[5] + h[4][1] + h[5][2], 1.718486),
        "c5y": (h[5][1] - h[6][2], 0.07705313),
        "c6x": (0.088 * m[7] + h[6][0], 0.1656804),
        "c6y": (h[6][1] - h[7][2], -0.06771177),
        "c7x": (h[7][0], 0.006231087),
    }
    for name, (retrieved, identified) in gravity.items():
        assert abs(retrieved - identified) < 0.01, name


def test_the_puma_falls_as_published():
    """Gravity torque of joint 2 with the arm stretched out, from the weights and arms of Armstrong,
    Khatib and Burdick (1986).
    """
    from asbuilt.dynamics import gravity_torque

    puma = load_robot("puma-560")
    tau = gravity_torque(puma, np.zeros(6))
    expected = -9.81 * (17.4 * 0.068 + 4.8 * 0.4318 + (0.82 + 0.34 + 0.09) * (0.4318 - 0.0203))
    assert np.isclose(tau[1], expected)
    assert np.isclose(tau[0], 0.0)


def test_a_bundled_scara_carries_only_the_weight_of_quill_and_tool():
    from asbuilt.dynamics import gravity_torque

    tau = gravity_torque(load_robot("scara"), [0.3, -0.2, 0.1, 0.5])
    assert np.allclose(tau, [0, 0, -9.81 * 1.4, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "kuka-iiwa",
            r"did you mean 'kuka-iiwa7-r800'.*bundled are dvrk-mtm, dvrk-psm, four-bar",
        ),
        ("PUMA560", r"did you mean 'puma-560'"),
        ("nonsense-xyz-123", r"no bundled robot and no file 'nonsense-xyz-123'; bundled are"),
        ("my/robot.urdf", r"there is no file my/robot\.urdf"),
        ("arm.xacro", r"there is no file arm\.xacro"),
    ],
)
def test_unknown_robots_are_answered_with_what_there_is(name, message):
    with pytest.raises(DescriptionError, match=message):
        load_robot(name)


def test_unknown_bundled_name():
    with pytest.raises(DescriptionError, match=r"no bundled robot 'ur10'.*did you mean 'ur10e'"):
        bundled_robot("ur10")


def test_files_are_told_apart_by_content(tmp_path):
    urdf = (
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="prismatic"><parent'
        ' link="a"/><child link="b"/></joint></robot>'
    )
    (tmp_path / "robot.xml").write_text(urdf)
    assert load_robot(tmp_path / "robot.xml").joints[0].kind == "prismatic"
    (tmp_path / "gazebo.urdf").write_text(
        "<?xml version='1.0'?><!-- <mujoco/> -->"
        + urdf.replace("</robot>", "<mujoco><compiler/></mujoco></robot>")
    )
    assert load_robot(tmp_path / "gazebo.urdf").n_joints == 1
    (tmp_path / "notes.xml").write_text("just text")
    with pytest.raises(DescriptionError, match="not a robot description"):
        load_robot(tmp_path / "notes.xml")
    with pytest.raises(DescriptionError, match="is a folder"):
        load_robot(tmp_path)


def test_zero_inertia_links_are_reported_only_if_given():
    model = load_robot("two-link")
    assert find_inconsistencies(
        model.with_parameters(
            np.concatenate(
                [LinkInertia.from_com(1, [0, 0, 0], np.diag([1, 1, 3])).parameters, np.zeros(10)]
            )
        )
    ) == ("link 1: Ixx + Iyy < Izz by 1 kg m^2 (about the centre of mass)",)
