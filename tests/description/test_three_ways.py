"""One robot given as standard DH, as modified DH in TOML and as URDF moves alike and needs the same
torques.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.description import (
    ROOT,
    DHRow,
    RobotModel,
    load_robot,
    placement,
    robot_from_dh,
    rpy_from_rotation,
)
from asbuilt.description.formats.toml import robot_from_toml
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.description.rotation import compose_placements, rotation_x, rotation_z
from asbuilt.dynamics import inverse_dynamics
from log_cholesky import from_log_cholesky

MOMENTS = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")


def rows_of(model: RobotModel, *, parents: list[int] | None = None) -> list[DHRow]:
    """Read the DH rows back from a standard DH robot, by the names of its lengths."""
    rows = []
    for i, (joint, link) in enumerate(zip(model.joints, model.links, strict=True)):
        alpha = np.arctan2(joint.after[2, 1], joint.after[2, 2])
        theta = np.arctan2(joint.before[1, 0], joint.before[0, 0])
        a, b = (model.lengths.get(f"{symbol}{i + 1}", 0.0) for symbol in "ab")
        parent = joint.parent if parents is None else parents[i]
        rows.append(
            DHRow(
                a=a,
                b=b,
                alpha=float(alpha),
                theta=float(theta),
                kind=joint.kind,
                inertia=link.inertia,
                parent=parent,
            )
        )
    return rows


def two_armed() -> list[DHRow]:
    rng = np.random.default_rng(11)
    parents = [ROOT, 0, 1, 2, 0, 4, 5, 6]
    kinds = [
        "revolute",
        "revolute",
        "prismatic",
        "revolute",
        "revolute",
        "revolute",
        "continuous",
        "prismatic",
    ]
    rows = []
    for parent, kind in zip(parents, kinds, strict=True):
        a, b, theta = rng.uniform(-0.5, 0.5, 3)
        alpha = rng.choice([np.pi / 2, -np.pi / 2, 0.0, 0.3])
        inertia = from_log_cholesky(rng.uniform(-1, 1, 10))
        rows.append(
            DHRow(a=a, b=b, alpha=alpha, theta=theta, kind=kind, inertia=inertia, parent=parent)
        )
    return rows


def distal(row: DHRow) -> np.ndarray:
    return placement(rotation_x(row.alpha), (row.a, 0.0, 0.0))


def modified_toml(rows: list[DHRow]) -> str:
    """Frame i moves to the axis of joint i.

    Row i takes length and twist of its parent row, link i moves by its own.
    """
    text = 'name = "modified"\nconvention = "modified"\n'
    for i, row in enumerate(rows):
        before = rows[row.parent] if row.parent != ROOT else DHRow()
        chi = row.inertia.moved(distal(row)).parameters
        parent = f"link_{row.parent + 1}" if row.parent != ROOT else "root"
        text += (
            f'[[links]]\nname = "link_{i + 1}"\nparent = "{parent}"\nkind = "{row.kind}"\n'
            f"dh = {{ a = {float(before.a)!r}, alpha = {float(before.alpha)!r}, d ="
            f" {float(row.b)!r}, theta = {float(row.theta)!r} }}\n"
            f"mass = {float(chi[9])!r}\nfirst_moment = {[float(x) for x in chi[6:9]]}\n"
            "inertia_about_origin = {"
            f" {', '.join(f'{n} = {float(x)!r}' for n, x in zip(MOMENTS, chi, strict=False))}"
            " }\n"
        )
    return text


def urdf_text(rows: list[DHRow], turned: bool) -> str:
    """Each link frame sits on its joint axis, turned at random where asked, so that the axis points
    anywhere.
    """
    rng = np.random.default_rng(4)
    C = [placement(Rotation.random(rng=rng).as_matrix()) if turned else np.eye(4) for _ in rows]
    A = [
        compose_placements(placement(rotation_z(row.theta), (0, 0, row.b)), distal(row))
        for row in rows
    ]
    text = '<robot name="three-ways"><link name="base"/>'
    for i, row in enumerate(rows):
        origin = C[i] if row.parent == ROOT else C[row.parent].T @ A[row.parent] @ C[i]
        inertia = row.inertia.moved(C[i].T @ A[i])
        I = inertia.inertia_about_com
        parent = "base" if row.parent == ROOT else f"link_{row.parent + 1}"
        tensor = " ".join(
            f'i{a}{b}="{float(I["xyz".index(a), "xyz".index(b)])!r}"'
            for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        text += (
            f'<link name="link_{i + 1}"><inertial><origin xyz="{numbers(inertia.com)}"/><mass'
            f' value="{inertia.mass!r}"/><inertia {tensor}/></inertial></link><joint'
            f' name="joint_{i + 1}" type="{row.kind}"><parent link="{parent}"/><child'
            f' link="link_{i + 1}"/><origin xyz="{numbers(origin[:3, 3])}"'
            f' rpy="{numbers(rpy_from_rotation(origin[:3, :3]))}"/><axis'
            f' xyz="{numbers(C[i][2, :3])}"/></joint>'
        )
    return text + "</robot>"


def numbers(values) -> str:
    return " ".join(repr(float(value)) for value in values)


def poses(model: RobotModel, q: np.ndarray) -> list[np.ndarray]:
    result: list[np.ndarray] = []
    for joint, angle in zip(model.joints, q, strict=True):
        motion = (
            placement(rotation_z(angle))
            if joint.is_revolute
            else placement(translation=(0, 0, angle))
        )
        above = np.eye(4) if joint.parent == ROOT else result[joint.parent]
        result.append(above @ joint.before @ motion @ joint.after)
    return result


ROBOTS = ["kuka-iiwa7-r800", "ur10e", "scara", "two-link", "two-armed tree"]


@pytest.fixture(params=ROBOTS)
def rows(request) -> list[DHRow]:
    return two_armed() if request.param == "two-armed tree" else rows_of(load_robot(request.param))


def test_three_descriptions_need_the_same_torques(rows):
    standard = robot_from_dh(rows)
    n = len(rows)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-2, 2, (3, 50, n))
    expected = inverse_dynamics(standard, q, qd, qdd)
    scale = np.abs(expected).max()
    for other in (
        robot_from_toml(modified_toml(rows)),
        read_urdf(urdf_text(rows, turned=False)),
        read_urdf(urdf_text(rows, turned=True)),
    ):
        assert np.abs(inverse_dynamics(other, q, qd, qdd) - expected).max() <= 1e-12 * scale


def test_three_descriptions_put_the_links_in_the_same_places(rows):
    q = np.random.default_rng(1).uniform(-2, 2, len(rows))
    standard = poses(robot_from_dh(rows), q)
    modified = poses(robot_from_toml(modified_toml(rows)), q)
    untouched = poses(read_urdf(urdf_text(rows, turned=False)), q)
    for row, T, M, U in zip(rows, standard, modified, untouched, strict=True):
        assert np.allclose(M @ distal(row), T, atol=1e-13)
        assert np.allclose(
            U @ placement(rotation_z(row.theta), (0, 0, row.b)) @ distal(row), T, atol=1e-13
        )


def test_bundled_dh_robots_survive_being_taken_apart():
    for name in ("kuka-iiwa7-r800", "ur10e", "scara"):
        model = load_robot(name)
        again = robot_from_dh(rows_of(model))
        for joint, copy in zip(model.joints, again.joints, strict=True):
            assert np.array_equal(joint.before, copy.before)
            assert np.array_equal(joint.after, copy.after)
            assert joint.after_symbols == copy.after_symbols
