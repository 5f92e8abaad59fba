from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from asbuilt.description import placement, rotation_from_rpy, rotation_onto, rpy_from_rotation
from asbuilt.description.rotation import (
    compose_placements,
    invert_placement,
    rotation_from_quaternion,
    rotation_x,
    rotation_y,
    rotation_z,
    round_to_right_angle,
    snap_entries,
)

angles = st.floats(-10.0, 10.0)


@pytest.mark.parametrize("quarters", range(-9, 10))
@pytest.mark.parametrize("rotation", [rotation_x, rotation_y, rotation_z])
def test_right_angles_have_no_rounding_noise(rotation, quarters):
    R = rotation(quarters * math.pi / 2)
    assert set(np.unique(np.abs(R))) <= {0.0, 1.0}
    assert np.allclose(R, rotation(quarters * math.pi / 2 + 1e-9), atol=2e-9)


def test_only_angles_near_a_right_angle_are_straightened():
    assert round_to_right_angle(1.5708) == math.pi / 2
    assert round_to_right_angle(-3.14159) == -math.pi
    assert round_to_right_angle(1.5709) == 1.5709
    assert round_to_right_angle(7e-6) == 0.0


def test_entries_at_the_border_are_snapped():
    assert rotation_from_rpy([1.0, 1e-12, 1.0])[2, 0] == 0.0
    assert rotation_from_rpy([1.0, 1.1e-12, 1.0])[2, 0] == pytest.approx(-1.1e-12, rel=1e-9)


@given(angles, angles, angles)
@settings(max_examples=60, deadline=None)
def test_rpy_agrees_with_scipy(roll, pitch, yaw):
    R, truth = (
        rotation_from_rpy([roll, pitch, yaw]),
        Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(),
    )
    from_whole = np.abs(truth - np.rint(truth))
    assume(
        not np.any(np.abs(from_whole - 1e-12) < 1e-15)
    )  # scipy's rounding decides whether what is snapped is off by more than 1e-12
    assert np.allclose(R, truth, atol=1e-12)
    assert np.allclose(rotation_from_rpy(rpy_from_rotation(R)), R, atol=1e-9)


@given(st.tuples(angles, angles, angles, angles).filter(lambda q: np.linalg.norm(q) > 1e-3))
@settings(max_examples=60, deadline=None)
def test_quaternion_agrees_with_scipy(wxyz):
    w, x, y, z = wxyz
    assert np.allclose(
        rotation_from_quaternion(wxyz), Rotation.from_quat([x, y, z, w]).as_matrix(), atol=1e-12
    )


@given(st.tuples(angles, angles, angles).filter(lambda a: np.linalg.norm(a) > 1e-3))
@settings(max_examples=60, deadline=None)
def test_rotation_onto_carries_z_onto_the_axis(axis):
    unit = np.array(axis) / np.linalg.norm(axis)
    R = rotation_onto(unit)
    assert np.allclose(R[:, 2], unit, atol=1e-12)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0


@pytest.mark.parametrize("axis", [s * np.eye(3)[i] for i in range(3) for s in (1, -1)])
def test_rotation_onto_is_exact_for_coordinate_axes(axis):
    R = rotation_onto(axis)
    assert np.array_equal(R[:, 2], axis)
    assert set(np.unique(np.abs(R))) == {0.0, 1.0}


def test_composition_stays_exact_and_inverts():
    quarter = placement(rotation_x(math.pi / 2), (1.0, 2.0, 3.0))
    T = compose_placements(*[quarter] * 4)
    assert np.array_equal(T[:3, :3], np.eye(3))
    assert np.allclose(invert_placement(quarter) @ quarter, np.eye(4), atol=1e-15)
    assert np.array_equal(
        snap_entries([[6e-17, 1 - 1e-16], [-1 + 1e-15, 0.5]]), [[0.0, 1.0], [-1.0, 0.5]]
    )
