"""What links can do and how parameters move, against Pinocchio; ranks against exact numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import ROOT, Joint, Link, LinkInertia, RobotModel, placement
from asbuilt.description.inertia import shift_matrix
from asbuilt.description.rotation import compose_placements, rotation_x, rotation_z
from asbuilt.dynamics.base.regrouping_relations import (
    SHIFT_LINEAR,
    SHIFT_SQUARE,
    SLIDE_SHIFTS,
    SLIDE_TWISTS,
    TURN_SHIFTS,
    TURN_TWISTS,
    characteristic_length,
    kinetic_functional,
    null_space,
    regrouping_relations,
    reversed_echelon,
    row_space,
)

pin = pytest.importorskip("pinocchio")

OF_PINOCCHIO = [4, 5, 7, 6, 8, 9, 1, 2, 3, 0]
"""Places of `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m` in Pinocchio's dynamic parameters."""
RNG = np.random.default_rng(3)
BODY = pin.Inertia.Random()
TURN, SLIDE = rotation_z(0.7), np.array([0.3, -0.4, 0.5])


def parameters(body) -> np.ndarray:
    return body.toDynamicParameters()[OF_PINOCCHIO]


def moved(rotation: np.ndarray, translation) -> np.ndarray:
    """Parameters of the body in a frame from which its own is turned and moved."""
    return parameters(pin.SE3(rotation, np.asarray(translation)).act(BODY))


def test_parameters_turn_and_move_as_pinocchios():
    p = parameters(BODY)
    turn = rotation_x(0.4) @ TURN
    np.testing.assert_allclose(
        shift_matrix(placement(turn)) @ p, moved(turn, np.zeros(3)), atol=1e-12
    )
    shift = (
        np.eye(10)
        + np.einsum("a,aij->ij", SLIDE, SHIFT_LINEAR)
        + np.einsum("a,b,abij->ij", SLIDE, SLIDE, SHIFT_SQUARE)
    )
    np.testing.assert_allclose(shift @ p, moved(np.eye(3), SLIDE), atol=1e-12)


@pytest.mark.parametrize("q", [0.0, 0.3, -2.0])
def test_a_joint_moves_parameters_and_twists_as_pinocchios(q: float):
    waves = np.array([1.0, np.cos(q), np.sin(q), np.cos(2 * q), np.sin(2 * q)])
    along = np.array([0.0, 0.0, q])
    of_turn, of_slide = (
        np.einsum("k,kij->ij", f, shifts)
        for f, shifts in ((waves, TURN_SHIFTS), (q ** np.arange(3), SLIDE_SHIFTS))
    )
    np.testing.assert_allclose(of_turn @ parameters(BODY), moved(rotation_z(q), 0 * along))
    np.testing.assert_allclose(of_slide @ parameters(BODY), moved(np.eye(3), along))
    swap = np.roll(np.eye(6), 3, axis=0)  # Pinocchio has the linear part first
    for f, moves, placed in (
        (waves[:3], TURN_TWISTS, pin.SE3(rotation_z(q), 0 * along)),
        (q ** np.arange(2), SLIDE_TWISTS, pin.SE3(np.eye(3), along)),
    ):
        theirs = swap @ placed.inverse().action @ swap
        np.testing.assert_allclose(np.einsum("k,kij->ij", f, moves), theirs, atol=1e-12)


def test_the_kinetic_functional_is_the_energy_and_symmetric():
    u, w = RNG.normal(size=(2, 6))
    ours = kinetic_functional(u, u) @ parameters(BODY)
    assert ours == pytest.approx(BODY.vtiv(pin.Motion(u[3:], u[:3])) / 2.0)
    both = kinetic_functional(u + w, u + w) - kinetic_functional(u, u) - kinetic_functional(w, w)
    np.testing.assert_allclose(2.0 * kinetic_functional(u, w), both, atol=1e-12)
    np.testing.assert_allclose(kinetic_functional(w, u), kinetic_functional(u, w), atol=1e-12)


ROWS = np.array([[2, 0, 1, 4, 0], [1, 3, 0, -1, 0], [3, 3, 1, 3, 0], [0, 0, 0, 0, 0]])
"""Of rank two, the third row a sum, the last column absent."""


@pytest.mark.parametrize("size", [1.0, 1e7])
def test_spans_are_those_of_exact_numbers(size: float):
    sympy = pytest.importorskip("sympy")
    exact = sympy.Matrix(ROWS.tolist())
    rows, kernel = size * ROWS, np.array(exact.nullspace(), dtype=float).reshape(-1, 5)
    span, null = row_space(rows), null_space(rows)
    assert span.shape == (exact.rank(), 5)
    assert null.shape == kernel.shape
    np.testing.assert_allclose(span @ span.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(null @ null.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(kernel - kernel @ null.T @ null, 0.0, atol=1e-12)
    np.testing.assert_allclose(ROWS - ROWS @ span.T @ span, 0.0, atol=1e-12)


def test_noise_relative_to_the_largest_row_is_no_direction_and_less_noise_is_one():
    for size, noise, rank in ((1e6, 1e-6, 1), (1e6, 1e-2, 2), (1.0, 1e-12, 1), (1.0, 1e-8, 2)):
        rows = np.array([[size, size, 0.0], [0.0, 0.0, noise]])
        assert len(row_space(rows)) == rank, (size, noise)
        assert len(null_space(rows)) == 3 - rank, (size, noise)
    tiny = np.array([[1e-11, 0.0]])
    assert len(row_space(tiny)) == 0, "alone it is noise too"
    assert len(null_space(tiny)) == 2
    assert row_space(np.zeros((0, 4))).shape == (0, 4)
    assert null_space(np.zeros((0, 4))).shape == (4, 4)


@pytest.mark.parametrize("size", [1.0, 1e-13, 1e9])
def test_the_reversed_echelon_form_is_that_of_exact_numbers(size: float):
    sympy = pytest.importorskip("sympy")
    reduced, pivots = sympy.Matrix(ROWS[:, ::-1].tolist()).rref()
    echelon, columns = reversed_echelon(size * ROWS[:3])
    assert columns.tolist() == [4 - pivot for pivot in pivots]
    expected = np.array(reduced, dtype=float)[: len(pivots), ::-1]
    np.testing.assert_allclose(echelon, expected, atol=1e-12)
    assert (echelon[:, 4] == 0.0).all()


def test_an_entry_that_rounding_left_is_no_pivot():
    noisy = np.array([[1.0, 1.0, 1e-11], [0.0, 1.0, 0.0]])
    echelon, columns = reversed_echelon(noisy)
    assert columns.tolist() == [1, 0]
    np.testing.assert_array_equal(echelon, [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    assert reversed_echelon(np.array([[1.0, 0.0, 1e-8]]))[1].tolist() == [2]
    assert reversed_echelon(np.zeros((0, 3)))[0].shape == (0, 3)


def chain(kinds: str, seed: int, gravity=(1.0, -2.0, 9.0)) -> RobotModel:
    """Joints in a tree at which frames are turned and moved, some by nothing."""
    rng = np.random.default_rng(seed)
    joints = []
    for i, kind in enumerate(kinds):
        before, after = (
            compose_placements(
                placement(
                    rotation_x(rng.choice([0.0, np.pi / 2, 0.8])) @ rotation_z(rng.uniform(-3, 3)),
                    rng.choice([0.0, 0.3, -0.6], size=3),
                )
            )
            for _ in range(2)
        )
        joints.append(
            Joint(
                name=f"j{i}",
                kind="revolute" if kind == "R" else "prismatic",
                parent=int(rng.integers(ROOT, i)) if i > 1 else i - 1,
                before=before,
                after=after,
            )
        )
    links = tuple(Link(name=f"l{i}", inertia=LinkInertia.zero()) for i in range(len(joints)))
    return RobotModel(
        name="tree", joints=tuple(joints), links=links, gravity=np.array(gravity, dtype=float)
    )


def in_pinocchio(model: RobotModel):
    built = pin.Model()
    for i, joint in enumerate(model.joints):
        parent = joint.parent
        here = joint.before if parent == ROOT else model.joints[parent].after @ joint.before
        kind = pin.JointModelRZ() if joint.is_revolute else pin.JointModelPZ()
        built.addJoint(parent + 1, kind, pin.SE3(here), f"j{i}")
    return built


def spans(rows: np.ndarray, basis: np.ndarray) -> bool:
    """Whether orthonormal rows span just what many rows do."""
    rank = np.linalg.matrix_rank(rows, rtol=1e-9)
    left = rows - rows @ basis.T @ basis
    return len(basis) == rank and np.abs(left).max(initial=0.0) < 1e-9 * np.abs(rows).max()


@pytest.mark.parametrize(
    ("kinds", "seed"), [("RRR", 0), ("RPR", 1), ("PRRP", 2), ("RRPRR", 3), ("PPR", 4)]
)
def test_what_links_can_do_is_what_pinocchios_jacobians_span(kinds: str, seed: int):
    model = chain(kinds, seed)
    n, size = model.n_joints, characteristic_length(model)
    _, motions = regrouping_relations(model, np.zeros((n, 5), dtype=bool))
    built = in_pinocchio(model)
    data, g = built.createData(), model.gravity / np.linalg.norm(model.gravity)
    found: list[list[list[np.ndarray]]] = [[[], [], [], []] for _ in range(n)]
    rng = np.random.default_rng(seed)
    for _ in range(60):
        q = np.where([joint.is_revolute for joint in model.joints], 3.0, size) * rng.uniform(
            -1.0, 1.0, n
        )
        pin.computeJointJacobians(built, data, q)
        for i in range(n):
            theirs = pin.getJointJacobian(built, data, i + 1, pin.LOCAL)
            J = np.vstack([theirs[3:], theirs[:3] / size])
            J[:, [not joint.is_revolute for joint in model.joints]] *= size
            moving = np.flatnonzero(np.abs(J).max(axis=0) > 0.0)
            twist = J @ rng.normal(size=n)
            for rows, new in zip(
                found[i],
                (
                    J.T[moving],
                    kinetic_functional(twist, twist)[None],
                    np.append(data.oMi[i + 1].rotation.T @ g, 1.0)[None],
                    np.hstack([J.T, np.eye(n)])[moving],
                ),
                strict=True,
            ):
                rows.append(new)
    for own, motion in zip(found, motions, strict=True):
        bases = (motion.twists, motion.kinetic, motion.gravity, motion.paced)
        for name, rows, basis in zip(
            ("twists", "kinetic", "gravity", "paced"), own, bases, strict=True
        ):
            assert spans(np.vstack(rows), basis), name


def test_without_gravity_no_direction_is_felt():
    _, motions = regrouping_relations(chain("RR", 0, (0.0, 0.0, 0.0)), np.zeros((2, 5), dtype=bool))
    for motion in motions:
        np.testing.assert_allclose(np.abs(motion.gravity), [[0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("offset", "size"), [(0.3, 0.25), (-0.4, 0.5), (0.0, 1.0), (100.0, 128.0), (0.001, 2.0**-10)]
)
def test_the_size_of_a_robot_is_the_power_of_two_next_to_its_largest_offset(offset, size):
    joint = Joint(name="j", kind="revolute", parent=ROOT, before=np.eye(4), after=np.eye(4))
    far = placement(np.eye(3), [0.0, offset, offset / 8.0])
    link = Link(name="l", inertia=LinkInertia.zero())
    for own in (replace(joint, before=far), replace(joint, after=far)):
        model = RobotModel(name="one", joints=(own,), links=(link,))
        assert characteristic_length(model) == size
