from __future__ import annotations

import re

import numpy as np
import pytest

from asbuilt.description import load_robot, placement, rotation_from_rpy
from asbuilt.dynamics import link_poses
from asbuilt.errors import DescriptionError, MotionError, UsageError
from asbuilt.excitation import DesignOptions, design_motion, design_static_poses
from asbuilt.excitation.collision.capsules import (
    Capsule,
    build_skeleton_capsules,
    build_surroundings,
    read_urdf_capsules,
)
from asbuilt.excitation.collision.constraint import CollisionGuard, ToolBox, build_constraints
from asbuilt.excitation.collision.distances import find_nearest_on_segments, find_nearest_to_box
from asbuilt.writers import design_text

coal = pytest.importorskip("coal")

CELL = """
skeleton = 0.05
floor = -0.1
clearance = 0.03
allowed = [["link_2", "link_4"]]
[[obstacles]]
name = "pillar"
size = [0.2, 0.2, 1.0]
position = [0.5, 0.1, 0.5]
rpy = [0.1, 0.2, 0.3]
"""


def transform(pose: np.ndarray):
    return coal.Transform3s(np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3]))


def upright(start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    z = (stop - start) / np.linalg.norm(stop - start)
    x = np.cross([0.3, 0.5, 0.8], z)
    x /= np.linalg.norm(x)
    return placement(np.column_stack([x, np.cross(z, x), z]), (start + stop) / 2)


def test_distances_between_capsules_are_those_of_coal() -> None:
    rng = np.random.default_rng(0)
    ends = rng.normal(size=(4, 300, 3))
    near = find_nearest_on_segments(ends[0], ends[1] - ends[0], ends[2], ends[3] - ends[2])
    for k in range(300):
        shapes = [
            coal.Capsule(0.1, float(np.linalg.norm(ends[i + 1, k] - ends[i, k]))) for i in (0, 2)
        ]
        places = [transform(upright(ends[i, k], ends[i + 1, k])) for i in (0, 2)]
        found = coal.distance(
            shapes[0],
            places[0],
            shapes[1],
            places[1],
            coal.DistanceRequest(),
            coal.DistanceResult(),
        )
        assert np.linalg.norm(near[1][k] - near[0][k]) - 0.2 == pytest.approx(found, abs=1e-6)


def test_points_and_parallel_segments_are_no_exception() -> None:
    origin, x = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    up = np.array([[0.0, 0, 2.0]])
    for first, second, apart in (
        ((origin, 0 * x), (up, 0 * x), 2.0),
        ((origin, x), (up, x), 2.0),
        ((origin, x), (up + 3 * x, x), np.hypot(2, 2)),
    ):
        a, b = find_nearest_on_segments(*first, *second)
        assert float(np.linalg.norm(a - b)) == pytest.approx(apart)


def test_distances_to_boxes_are_those_of_coal() -> None:
    rng = np.random.default_rng(1)
    half = np.array([0.3, 0.5, 0.1])
    start, stop = rng.normal(size=(2, 300, 3))
    _, distance, normal = find_nearest_to_box(start, stop - start, half)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0)
    outside = 0
    for k in range(300):
        capsule = coal.Capsule(0.02, float(np.linalg.norm(stop[k] - start[k])))
        box = coal.Box(*(2 * half))
        place = transform(upright(start[k], stop[k]))
        found = coal.distance(
            capsule, place, box, coal.Transform3s(), coal.DistanceRequest(), coal.DistanceResult()
        )
        if found > 1e-3:
            outside += 1
            assert distance[k] - 0.02 == pytest.approx(found, abs=1e-5)
        else:
            assert distance[k] - 0.02 < 2e-3
    assert outside > 100


@pytest.fixture
def guard(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    model = load_robot("kuka-iiwa7-r800")
    return model, CollisionGuard(model, build_surroundings(model, path))


def test_derivatives_are_central_differences(guard) -> None:
    model, watch = guard
    box = ToolBox(model, np.array([-0.5, -0.5, 0.1]), np.array([0.5, 0.6, 1.1]))
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (80, 7))
    rest = np.zeros_like(q)
    clear = watch._measure_distances(q)[0].min(axis=1) > 0.0
    for constraint, which in ((watch, clear), (box, slice(None))):
        found = constraint.slopes(q, rest, rest)
        for j in range(7):
            way = 1e-6 * np.eye(7)[j]
            slope = (
                constraint.values(q + way, rest, rest) - constraint.values(q - way, rest, rest)
            ) / 2e-6
            assert found[which][:, :, j, 0] == pytest.approx(slope[which], abs=1e-5)


def test_pairs_that_touch_by_construction_or_permission_are_left_out(guard) -> None:
    model, watch = guard
    assert "link_1 - link_3" in watch.left_out
    names = [model.link_names[capsule.link] for capsule in build_skeleton_capsules(model, 0.05)]
    assert not any(
        {names[a], names[b]} == {"link_2", "link_4"} for a, b in watch.pairs if b < len(names)
    )


@pytest.mark.study
def test_an_obstacle_around_the_robot_is_told_not_passed_over(tmp_path) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(
        'skeleton = 0.05\n[[obstacles]]\nname = "crate"\nsize = [0.5, 0.5, 1.0]\nposition = [0, 0,'
        " 0.5]\n"
    )
    model = load_robot("kuka-iiwa7-r800")
    constraints = build_constraints(model, collision=str(cell))
    options = DesignOptions(duration=4.0, size=2, starts=1, drive="none")
    design = design_motion(model, options, constraints=constraints, with_bound=False, cores=1)
    standing = design_static_poses(model, 4, constraints=constraints)
    for written in (design_text(design), design_text(standing)):
        text = " ".join(written.split())
        assert re.search(r"NOT CHECKED, they touch in nearly every pose: .*link_\d - crate", text)


@pytest.mark.study
def test_a_design_keeps_clear_and_in_the_box(guard) -> None:
    model, watch = guard
    box = ToolBox(model, np.array([-0.7, -0.7, 0.0]), np.array([0.7, 0.7, 1.2]))
    options = DesignOptions(duration=4.0, size=3, starts=1, drive="viscous")
    design = design_motion(model, options, constraints=(watch, box), with_bound=False)
    assert design.collision_distance >= 0.03 - 1e-6
    assert watch.smallest_distance(design.motion.at(np.linspace(0, 4, 5001))[0]) >= 0.03 - 1e-4
    q = design.motion.at(np.linspace(0, 4, 5001))[0]
    poses = link_poses(model, q)[:, -1]
    flange = next(frame for frame in model.frames if frame.name == "flange").placement[:3, 3]
    tool = poses[:, :3, :3] @ flange + poses[:, :3, 3]
    room = 1000 * min(
        float((0.7 - np.abs(tool[:, :2])).min()),
        float(tool[:, 2].min()),
        float((1.2 - tool[:, 2]).min()),
    )
    assert f"the tool keeps {room:.0f} mm from the sides of its box" in design.notes
    assert np.all(np.abs(tool[:, :2]) <= 0.7 + 1e-4)
    assert np.all((tool[:, 2] >= -1e-4) & (tool[:, 2] <= 1.2 + 1e-4))


def test_a_capsule_around_points_holds_them_and_is_slim() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        turn = rotation_from_rpy(rng.normal(size=3))
        points = rng.uniform(-1, 1, (200, 3)) * [1.0, 0.2, 0.1] @ turn.T + rng.normal(size=3)
        capsule = Capsule.around(0, points)
        along = capsule.stop - capsule.start
        s = np.clip((points - capsule.start) @ along / (along @ along), 0, 1)
        assert np.all(
            np.linalg.norm(points - capsule.start - s[:, None] * along, axis=1)
            <= capsule.radius * (1 + 1e-9)
        )
        assert capsule.radius < 0.26


URDF = """<robot name="r"><link name="base"/>
  <link name="arm"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 0.5" rpy="0 0 0"/>
  <geometry><cylinder radius="0.1" length="1.0"/></geometry></collision></link>
<link name="hand"><collision><geometry><sphere radius="0.2"/></geometry></collision></link>
<joint name="j" type="revolute">
  <parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" velocity="1" effort="10"/></joint>
<joint name="f" type="fixed"><parent link="arm"/><child link="hand"/>
  <origin xyz="0 0 1"/></joint></robot>"""


def test_geometry_of_a_urdf_becomes_capsules_on_the_links_that_carry_it(tmp_path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(URDF)
    arm, hand = read_urdf_capsules(load_robot(str(path)), path)
    assert (arm.link, hand.link) == (0, 0)
    assert arm.radius == pytest.approx(0.1, rel=0.02)
    assert sorted([arm.start[2], arm.stop[2]]) == pytest.approx([0.0, 1.0], abs=0.03)
    assert hand.start == pytest.approx([0, 0, 1])
    assert hand.radius == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("floor = 0", "nothing can collide"),
        ("skeleton = -1", "must be positive"),
        ("skeleton = 0.1\nwall = 3", "wall"),
        (
            '[[capsules]]\nlink = "link_9"\nstart = [0,0,0]\nstop = [0,0,1]\nradius = 0.1',
            "no link 'link_9'",
        ),
        ("skeleton = ", "cannot be read"),
        ("skeleton = 0.1\nclearance = -0.02", "clearance.*greater than or equal to 0"),
        ("skeleton = 0.1\nfloor = nan", "floor.*finite"),
        (
            "skeleton = 0.1\n[[obstacles]]\nsize = [1, 0, 1]\nposition = [0, 0, 0]",
            "size.*greater than 0",
        ),
    ],
)
def test_files_that_make_no_sense_are_refused(tmp_path, text: str, said: str) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(DescriptionError, match=said):
        build_surroundings(load_robot("kuka-iiwa7-r800"), path)


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ('<cylinder length="1"/>', "link 'arm', collision.*radius"),
        ('<sphere radius="big"/>', "link 'arm', collision.*'big'"),
        ('<mesh filename="broken.stl"/>', "broken.stl.*skeleton:RADIUS"),
    ],
)
def test_shapes_that_cannot_be_read_are_named(tmp_path, shape: str, said: str) -> None:
    (tmp_path / "broken.stl").write_text("solid arm\nfacet nonsense")
    path = tmp_path / "r.urdf"
    path.write_text(re.sub(r"<(cylinder|sphere|box) [^>]*/>", shape, URDF))
    with pytest.raises(DescriptionError, match=said):
        read_urdf_capsules(load_robot(str(path)), path)


def test_wrong_boxes_and_frames_are_refused() -> None:
    model = load_robot("kuka-iiwa7-r800")
    with pytest.raises(UsageError, match="six numbers"):
        build_constraints(model, tool_box=(1.0, 2.0))
    with pytest.raises(MotionError, match="positive extent"):
        build_constraints(model, tool_box=(1.0, 0.0, 0.0, 1.0, 0.0, 1.0))
    with pytest.raises(MotionError, match="no moving frame 'hand'"):
        build_constraints(model, tool_box=(0.0, 1.0, 0.0, 1.0, 0.0, 1.0), tool_frame="hand")
