from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from asbuilt.description import LinkInertia, placement
from asbuilt.description.inertia import pseudo_inertias, shift_matrix
from asbuilt.errors import InertiaError
from log_cholesky import from_log_cholesky, log_cholesky

coordinates = st.floats(-2.0, 2.0)
logarithms = st.lists(st.floats(-1.5, 1.5), min_size=10, max_size=10)
placements = st.tuples(
    st.lists(coordinates, min_size=3, max_size=3),
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
).map(lambda given: placement(Rotation.from_rotvec(given[1]).as_matrix(), given[0]))


def cloud(rng: np.random.Generator, n: int = 30) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(0.1, 1.0, n), rng.normal(size=(n, 3))


def inertia_of(masses: np.ndarray, points: np.ndarray) -> LinkInertia:
    squared = np.einsum("n,ni,nj->ij", masses, points, points)
    return LinkInertia.from_origin(
        masses.sum(), masses @ points, np.trace(squared) * np.eye(3) - squared
    )


@given(logarithms)
@settings(max_examples=80, deadline=None)
def test_every_view_returns_to_the_same_ten_numbers(theta):
    link = from_log_cholesky(theta)
    scale = np.abs(link.parameters).max()
    assert np.allclose(log_cholesky(link), theta, atol=1e-8)
    for again in (
        LinkInertia.from_com(link.mass, link.com, link.inertia_about_com),
        LinkInertia.from_origin(link.mass, link.first_moment, link.inertia),
        LinkInertia.from_pseudo_inertia(link.pseudo_inertia),
        LinkInertia.from_pinocchio_order(link.to_pinocchio_order()),
    ):
        assert np.allclose(again.parameters, link.parameters, atol=1e-12 * scale)
    assert link.is_consistent
    assert np.linalg.eigvalsh(link.pseudo_inertia).min() > 0


@given(logarithms)
@settings(max_examples=40, deadline=None)
def test_ten_vector_and_pseudo_inertia_agree_with_pinocchio(theta):
    link = from_log_cholesky(theta)
    oracle = pin.Inertia(link.mass, link.com, link.inertia_about_com)
    assert np.allclose(link.to_pinocchio_order(), oracle.toDynamicParameters(), atol=1e-10)
    assert np.allclose(link.pseudo_inertia, oracle.toPseudoInertia().toMatrix(), atol=1e-10)


@given(placements, st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_moving_a_body_is_moving_its_points(T, seed):
    masses, points = cloud(np.random.default_rng(seed))
    link = inertia_of(masses, points)
    there = inertia_of(masses, points @ T[:3, :3].T + T[:3, 3])
    assert np.allclose(link.moved(T).parameters, there.parameters, atol=1e-9)
    assert np.allclose(shift_matrix(T) @ link.parameters, there.parameters, atol=1e-9)
    assert np.allclose(link.moved(T).principal_moments, link.principal_moments, atol=1e-8)


def test_shift_matrices_compose():
    rng = np.random.default_rng(3)
    A, B = (placement(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)) for _ in range(2))
    assert np.allclose(shift_matrix(A) @ shift_matrix(B), shift_matrix(A @ B), atol=1e-12)


def test_two_bodies_add_and_part():
    rng = np.random.default_rng(5)
    first, second = cloud(rng), cloud(rng)
    together = inertia_of(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))
    total = inertia_of(*first) + inertia_of(*second)
    assert np.allclose(total.parameters, together.parameters, atol=1e-12)
    assert np.allclose(
        (total - inertia_of(*second)).parameters, inertia_of(*first).parameters, atol=1e-12
    )


@pytest.mark.parametrize(
    ("tensor", "reason"),
    [
        (np.diag([0.01, 0.02, 0.0309]), "Ixx + Iyy < Izz by 0.0009 kg m^2"),
        (np.diag([0.0309, 0.02, 0.01]), "Iyy + Izz < Ixx by 0.0009 kg m^2"),
        (np.diag([-0.01, 0.02, 0.02]), "Ixx about the centre of mass is -0.01 kg m^2"),
        (
            [[0.02, 0.015, 0], [0.015, 0.02, 0], [0, 0, 0.02]],
            "the largest exceeds the sum of the others by 0.01",
        ),
    ],
)
def test_an_impossible_tensor_is_refused_with_a_reason(tensor, reason):
    link = LinkInertia.from_com(3.0, [0.1, -0.2, 0.3], tensor)
    assert reason in (link.inconsistency() or "")
    assert not link.is_consistent
    assert np.linalg.eigvalsh(link.pseudo_inertia).min() < 0


def test_masses_must_be_positive_but_nothing_is_nothing():
    assert "mass is -1 kg" in (
        LinkInertia.from_com(-1.0, np.zeros(3), np.eye(3)).inconsistency() or ""
    )
    assert "mass is 0 kg" in (
        LinkInertia.from_com(0.0, np.zeros(3), np.eye(3)).inconsistency() or ""
    )
    assert LinkInertia.zero().is_consistent


@pytest.mark.parametrize("offset", [0.0, 1.0, 100.0])
def test_flat_and_point_bodies_are_consistent_wherever_they_sit(offset):
    plate = LinkInertia.from_com(2.0, [offset, -offset, offset], np.diag([0.1, 0.2, 0.3]))
    point = LinkInertia.from_com(2.0, [offset, 0.0, 0.0], np.zeros((3, 3)))
    assert plate.is_consistent
    assert point.is_consistent


@given(logarithms, st.floats(1e-3, 0.5))
@settings(max_examples=40, deadline=None)
def test_consistency_is_the_sign_of_the_smallest_eigenvalue(theta, excess):
    J = from_log_cholesky(theta).pseudo_inertia
    values, vectors = np.linalg.eigh(J)
    broken = J - (values[0] + excess * values[-1]) * np.outer(vectors[:, 0], vectors[:, 0])
    assert not LinkInertia.from_pseudo_inertia(broken).is_consistent


def test_nonsense_is_refused_at_the_door():
    with pytest.raises(InertiaError, match="Iyz is not finite"):
        LinkInertia(np.array([0, 0, 0, 0, np.nan, 0, 0, 0, 0, 1.0]))
    with pytest.raises(InertiaError, match="10 numbers"):
        LinkInertia(np.zeros(9))
    with pytest.raises(InertiaError, match="symmetric"):
        LinkInertia.from_pseudo_inertia(np.triu(np.ones((4, 4))))
    with pytest.raises(InertiaError, match="10 numbers"):
        LinkInertia.from_pinocchio_order(np.zeros(6))
    with pytest.raises(ValueError, match="read-only"):
        LinkInertia.zero().parameters[0] = 1.0


def test_many_pseudo_inertias_at_once():
    chi = np.random.default_rng(0).normal(size=(4, 5, 10))
    J = pseudo_inertias(chi)
    assert J.shape == (4, 5, 4, 4)
    assert np.allclose(J[2, 3], LinkInertia(chi[2, 3]).pseudo_inertia)
