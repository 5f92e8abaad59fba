"""The way through standing poses, in a plane with a wall, and for real robots among bodies and in a
box.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import link_poses
from asbuilt.errors import MotionError
from asbuilt.excitation import MotionBounds, design_static_poses
from asbuilt.excitation.collision.constraint import build_constraints
from asbuilt.excitation.design.route import Roadmap, find_short_tour, plan_route
from asbuilt.excitation.state_constraint import StateConstraint


class Wall(StateConstraint):
    """Keep out of `|x| < 0.2` as far as y is below a height."""

    name = "wall"
    two_sided = False

    def __init__(self, height: float) -> None:
        self.height = height

    def values(self, q, qd, qdd):
        inside = np.minimum(0.2 - np.abs(q[:, 0]), self.height - q[:, 1])
        return 1 + inside[:, None]

    def slopes(self, q, qd, qdd):
        raise NotImplementedError


PLANE = MotionBounds(*(np.array([value, value]) for value in (-1.0, 1.0, 1.0, 4.0, np.inf, np.inf)))
POSES = np.array([[-0.8, -0.5], [0.8, -0.4], [-0.6, 0.1], [0.7, 0.2]])


def test_the_way_turns_over_a_wall_and_rests_at_every_pose_once() -> None:
    stations = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    wall = Wall(0.5)
    kept = stations[wall.values(stations, stations, stations)[:, 0] < 1]
    poses, motion, turns = plan_route(
        POSES, Roadmap.of(kept, PLANE, [wall]), PLANE, [wall], [], 0.5
    )
    q, qd, qdd = motion.at(motion.sample_times(500.0))
    assert np.all(wall.values(q, qd, qdd) < 1)
    assert turns > 0
    assert sorted(poses.tolist()) == sorted(POSES.tolist())
    for pose in POSES:
        assert np.abs(q - pose).max(axis=1).min() < 1e-3
    standing = np.abs(qd).max(axis=1) < 1e-9
    rests = [len(list(run)) for still, run in itertools.groupby(standing) if still]
    assert sum(count > 200 for count in rests) == len(POSES) - 2


def test_a_free_way_has_no_turns_and_one_that_is_closed_is_refused() -> None:
    stations = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    assert plan_route(POSES, None, PLANE, [], [], 0.0)[2] == 0
    wall = Wall(2.0)
    kept = stations[wall.values(stations, stations, stations)[:, 0] < 1]
    with pytest.raises(MotionError, match="no route without collision was found from"):
        plan_route(POSES, Roadmap.of(kept, PLANE, [wall]), PLANE, [wall], [], 0.0)


def test_a_roadmap_is_one_piece() -> None:
    stations = np.random.default_rng(0).uniform(-1, 1, (300, 2))
    wall = Wall(2.0)
    kept = stations[wall.values(stations, stations, stations)[:, 0] < 1]
    roadmap = Roadmap.of(kept, PLANE, [wall])
    assert len({bool(side) for side in roadmap.nodes[:, 0] > 0}) == 1
    assert len(roadmap.nodes) == max(np.sum(kept[:, 0] > 0), np.sum(kept[:, 0] < 0))


def test_short_tours_of_few_places_are_the_shortest() -> None:
    rng = np.random.default_rng(4)
    for _ in range(5):
        places = rng.uniform(size=(7, 2))
        apart = np.abs(places[:, None] - places[None]).max(axis=2)
        best = min(
            sum(apart[i, j] for i, j in itertools.pairwise(order))
            for order in itertools.permutations(range(7))
        )
        tour = find_short_tour(apart)
        assert sorted(tour) == list(range(7))
        assert sum(apart[i, j] for i, j in itertools.pairwise(tour)) < 1.1 * best


@pytest.mark.study
def test_standing_poses_are_reached_clear_of_bodies_and_within_the_box() -> None:
    model = load_robot("franka-panda")
    box = (-1.2, 1.2, -1.2, 1.2, 0.05, 1.6)
    guard = build_constraints(model, collision="skeleton:0.06", tool_box=box)
    design = design_static_poses(model, 12, constraints=guard)
    q = design.motion.at(design.motion.sample_times(1000.0))[0]
    assert len(design.poses) == 12
    assert design.collision_distance == pytest.approx(guard[0].smallest_distance(q), abs=1e-4)
    assert design.collision_distance > 0.019
    frame = [item for item in model.frames if item.link >= 0][-1]
    links = link_poses(model, q)[:, frame.link]
    tool = links[:, :3, :3] @ frame.placement[:3, 3] + links[:, :3, 3]
    lower, upper = np.array(box).reshape(3, 2).T
    assert np.all((tool > lower) & (tool < upper))
    assert design.limits.worst_margin["torque"] > 0


def test_joints_of_many_turns_stand_near_the_middle_of_where_they_can_go() -> None:
    model = load_robot("ur10e")
    design = design_static_poses(model, 12)
    assert np.all(np.abs(design.poses[:, [0, 3, 4, 5]]) <= np.pi + 0.5)
    assert design.route_time < 20
