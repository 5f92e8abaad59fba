"""What is written as MJCF must be read back, by MuJoCo's compiler, as the same robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pinocchio_oracle import random_robot

from asbuilt.description import (
    DriveValues,
    LinkInertia,
    RobotModel,
    bundled_robot,
    link_solids,
    quaternion_from_rotation,
    robot_names,
)
from asbuilt.description.appearance import inertia_ellipsoid
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.description.rotation import rotation_from_quaternion
from asbuilt.errors import InertiaError


@pytest.mark.parametrize(
    "model",
    [
        bundled_robot("ur10e"),
        bundled_robot("scara"),
        random_robot(np.random.default_rng(3), 6, chain=True),
    ],
    ids=lambda m: m.name,
)
def test_written_robot_is_read_back(model: RobotModel) -> None:
    text = format_mjcf(model)
    back = read_mjcf(text)
    assert back.joint_names == model.joint_names
    assert back.link_names == model.link_names
    assert back.parents == model.parents
    assert [joint.is_revolute for joint in back.joints] == [
        joint.is_revolute for joint in model.joints
    ]
    np.testing.assert_allclose(back.parameters, model.parameters, atol=1e-12)
    np.testing.assert_allclose(back.gravity, model.gravity, atol=1e-15)
    for mine, other in zip(model.joints, back.joints, strict=True):
        np.testing.assert_allclose(other.before @ other.after, mine.before @ mine.after, atol=1e-12)
        assert (other.limits.lower, other.limits.upper, other.limits.torque) == (
            mine.limits.lower,
            mine.limits.upper,
            mine.limits.torque,
        )


def test_drive_values_and_frames_survive() -> None:
    model = bundled_robot("ur10e")
    drive = DriveValues(armature=0.3, viscous=2.0, coulomb=1.5)
    model = replace(model, joints=tuple(replace(joint, drive=drive) for joint in model.joints))
    back = read_mjcf(format_mjcf(model))
    assert {joint.drive for joint in back.joints} == {drive}
    assert [frame.name for frame in back.frames] == [frame.name for frame in model.frames]
    np.testing.assert_allclose(back.frames[0].placement, model.frames[0].placement, atol=1e-12)


def test_an_impossible_inertia_is_refused_by_name() -> None:
    model = bundled_robot("two-link")
    odd = LinkInertia.from_com(1.0, np.zeros(3), np.diag([1.0, 1.0, 3.0]))
    with pytest.raises(
        InertiaError,
        match=(
            r"two-link: link 'link_2' cannot be written as MJCF, whose bodies must be possible: .*"
        ),
    ):
        format_mjcf(replace(model, links=(model.links[0], replace(model.links[1], inertia=odd))))


def test_quaternions_of_rotations() -> None:
    rng = np.random.default_rng(0)
    for q in [*rng.normal(size=(200, 4)), *np.eye(4), [1, 1, 0, 0], [0, 1, 1, 0], [1e-9, 1, 0, 0]]:
        R = rotation_from_quaternion(q)
        np.testing.assert_allclose(
            rotation_from_quaternion(quaternion_from_rotation(R)), R, atol=1e-14
        )


@pytest.mark.parametrize("name", robot_names())
def test_solids_are_drawn_for_every_robot_without_weight(name: str) -> None:
    model = bundled_robot(name)
    solids = link_solids(model)
    assert {solid.link for solid in solids} >= set(range(model.n_joints))
    assert all(solid.length > 1e-4 and solid.radius > 0 for solid in solids)


def test_ellipsoid_of_uniform_density_has_the_inertia() -> None:
    rng = np.random.default_rng(2)
    for link in bundled_robot("kuka-iiwa7-r800").links:
        semi_axes, axes = inertia_ellipsoid(link.inertia) or pytest.fail("no ellipsoid")
        points = rng.normal(size=(400_000, 3))
        points *= (rng.random((len(points), 1)) ** (1 / 3)) / np.linalg.norm(
            points, axis=1, keepdims=True
        )
        points = (points * semi_axes) @ axes.T
        second = points.T @ points / len(points) * link.inertia.mass
        tensor = np.trace(second) * np.eye(3) - second
        np.testing.assert_allclose(
            tensor, link.inertia.inertia_about_com, atol=5e-3 * np.trace(tensor)
        )
    assert inertia_ellipsoid(LinkInertia.zero()) is None
