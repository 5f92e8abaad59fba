"""Base parameters of random trees, exact special cases included, against singular values and
against Pinocchio.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asbuilt.description import ROOT, Joint, Link, LinkInertia, RobotModel, placement
from asbuilt.description.rotation import compose_placements, rotation_x, rotation_y, rotation_z
from asbuilt.dynamics import (
    BaseParameters,
    DriveSet,
    find_base_parameters,
    observation_matrix,
    observation_rank,
)

TERMS = ("armature", "viscous", "coulomb", "offset")
QUARTERS = st.sampled_from([0.0, np.pi / 2, np.pi, -np.pi / 2])
LENGTHS = st.sampled_from([0.0, 0.0, 0.3, -0.45, 0.82])
GRAVITIES = st.sampled_from(
    [(0.0, 0.0, -9.81), (0.0, 9.81, 0.0), (0.0, 0.0, 0.0), (3.0, -4.0, 7.0)]
)
NO_LIMIT = settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))


@st.composite
def placements(draw: st.DrawFn) -> np.ndarray:
    turn = draw(st.sampled_from([rotation_x, rotation_y, rotation_z]))(draw(QUARTERS))
    if draw(st.booleans()):
        turn = turn @ rotation_x(draw(st.sampled_from([0.0, 0.0, 0.7, -1.1])))
    return compose_placements(placement(turn, [draw(LENGTHS) for _ in range(3)]))


@st.composite
def robots(draw: st.DrawFn, most: int = 6) -> RobotModel:
    joints = []
    for i in range(draw(st.integers(1, most))):
        parent = i - 1 if draw(st.integers(0, 3)) else draw(st.integers(ROOT, i - 1))
        kind = draw(st.sampled_from(["revolute", "revolute", "prismatic"]))
        joints.append(
            Joint(
                name=f"j{i}",
                kind=kind,
                parent=parent,
                before=draw(placements()),
                after=draw(placements()),
            )
        )
    links = tuple(
        Link(name=f"l{i}", inertia=LinkInertia(np.arange(10.0) + i)) for i in range(len(joints))
    )
    return RobotModel(
        name="random", joints=tuple(joints), links=links, gravity=np.array(draw(GRAVITIES))
    )


def stacked(model: RobotModel, drive: DriveSet, seed: int = 5, samples: int = 40) -> np.ndarray:
    q, qd, qdd = np.random.default_rng(seed).uniform(-3.0, 3.0, (3, samples, model.n_joints))
    return observation_matrix(model, q, qd, qdd, drive=drive)


def scaled(Y: np.ndarray) -> np.ndarray:
    sizes = np.linalg.norm(Y, axis=0)
    present = sizes > 1e-12 * sizes.max()
    return np.where(present, Y / np.where(present, sizes, 1.0), 0.0)


def first_independent(Y: np.ndarray) -> list[int]:
    """Go through the columns in order and keep those that stand out of the span of the kept ones
    (modified Gram-Schmidt, twice).
    """
    basis = np.zeros((0, Y.shape[0]))
    kept = []
    for j, column in enumerate(scaled(Y).T):
        rest = column - basis.T @ (basis @ column)
        rest = rest - basis.T @ (basis @ rest)
        if np.linalg.norm(rest) > 1e-7:
            basis = np.vstack([basis, rest / np.linalg.norm(rest)])
            kept.append(j)
    return kept


def rank_with_gap(Y: np.ndarray) -> int:
    sizes = np.linalg.svd(scaled(Y), compute_uv=False)
    rank = int(np.sum(sizes > 1e-9 * sizes[0]))
    assert sizes[rank - 1] > 1e-6 * sizes[0]
    assert rank == len(sizes) or sizes[rank] < 1e-12 * sizes[0]
    return rank


def assert_regroups(base: BaseParameters, Y: np.ndarray) -> None:
    error = np.abs(Y[:, base.columns] @ base.regrouping - Y).max()
    assert error <= 1e-10 * np.abs(Y).max()


@pytest.mark.slow
@NO_LIMIT
@given(model=robots(), terms=st.sets(st.sampled_from(TERMS)))
def test_structure_and_singular_values_agree(model: RobotModel, terms: set[str]) -> None:
    drive = DriveSet.parse(sorted(terms))
    base = find_base_parameters(model, drive)
    Y = stacked(model, drive)
    assert base.n_base == rank_with_gap(Y)
    assert base.columns.tolist() == first_independent(Y)
    assert_regroups(base, stacked(model, drive, seed=6, samples=7))


@pytest.mark.study
@NO_LIMIT
@given(model=robots(), terms=st.sets(st.sampled_from(TERMS)))
def test_verdicts_are_those_of_the_row_space(model: RobotModel, terms: set[str]) -> None:
    drive = DriveSet.parse(sorted(terms))
    base = find_base_parameters(model, drive)
    Y = scaled(stacked(model, drive))
    _, sizes, rows = np.linalg.svd(Y, full_matrices=True)
    null = rows[int(np.sum(sizes > 1e-9 * sizes[0])) :]
    for j, parameter in enumerate(base.standard):
        seen = bool(np.linalg.norm(Y[:, j]) > 0.0)
        alone = seen and bool(np.linalg.norm(null[:, j]) < 1e-7)
        assert parameter.status == (
            "identifiable" if alone else "grouped" if seen else "unidentifiable"
        ), parameter
        assert parameter.why.startswith(f"{parameter.name}: ")
        assert parameter.members == tuple(base.ids[np.flatnonzero(base.regrouping[:, j])])


@pytest.mark.parametrize("seed", range(6))
def test_row_space_is_pinocchios(seed: int) -> None:
    pin = pytest.importorskip("pinocchio")
    rng = np.random.default_rng(seed)
    joints, built = [], pin.Model()
    gravity = rng.normal(scale=6.0, size=3)
    built.gravity.linear = gravity
    for i in range(6):
        parent = int(rng.integers(ROOT, i))
        turns = [
            rotation_x(rng.choice([0.0, np.pi / 2, 0.8])) @ rotation_z(rng.uniform(-3, 3))
            for _ in range(2)
        ]
        before, after = (
            compose_placements(placement(turn, rng.normal(scale=0.4, size=3))) for turn in turns
        )
        kind = "prismatic" if rng.uniform() < 0.3 else "revolute"
        joints.append(Joint(name=f"j{i}", kind=kind, parent=parent, before=before, after=after))
        here = before if parent == ROOT else joints[parent].after @ before
        number = built.addJoint(
            parent + 1,
            pin.JointModelPZ() if kind == "prismatic" else pin.JointModelRZ(),
            pin.SE3(here),
            f"j{i}",
        )
        built.appendBodyToJoint(number, pin.Inertia.Random(), pin.SE3.Identity())
    links = tuple(Link(name=f"l{i}", inertia=LinkInertia.zero()) for i in range(6))
    model = RobotModel(name="random", joints=tuple(joints), links=links, gravity=gravity)
    base = find_base_parameters(model)
    data = built.createData()
    pinocchios = np.vstack(
        [
            pin.computeJointTorqueRegressor(built, data, *rng.uniform(-2.0, 2.0, (3, 6)))
            for _ in range(40)
        ]
    )
    to_ours = np.zeros((60, 60))
    for i, joint in enumerate(joints):
        for k in range(10):
            moved = LinkInertia(np.eye(10)[k]).moved(joint.after)
            to_ours[10 * i : 10 * i + 10, 10 * i + k] = moved.to_pinocchio_order()
    Y = pinocchios @ to_ours
    assert (
        base.n_base
        == rank_with_gap(pinocchios)
        == rank_with_gap(np.vstack([Y / np.abs(Y).max(), base.regrouping]))
    )
    assert_regroups(base, Y)


@pytest.mark.parametrize("n_joints", [1, 12, 30])
def test_long_chains(n_joints: int) -> None:
    rng = np.random.default_rng(n_joints)
    joints = tuple(
        Joint(
            name=f"j{i}",
            kind="revolute" if rng.uniform() < 0.8 else "prismatic",
            parent=i - 1,
            before=placement(
                rotation_x(np.pi / 2 * rng.integers(4)), rng.choice([0.0, 0.2, 0.5], 3)
            ),
            after=np.eye(4),
        )
        for i in range(n_joints)
    )
    model = RobotModel(
        name="chain",
        joints=joints,
        links=tuple(Link(name=f"l{i}", inertia=LinkInertia.zero()) for i in range(n_joints)),
    )
    drive = DriveSet.parse(",".join(TERMS))
    base = find_base_parameters(model, drive)
    Y = stacked(model, drive, samples=24)
    assert base.n_base == rank_with_gap(Y) == observation_rank(model, drive).rank
    assert_regroups(base, Y)
