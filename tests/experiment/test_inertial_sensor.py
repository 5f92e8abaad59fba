"""Base of a biped from an inertial sensor and feet that stand: as constructed, or refused by name.

Feet stand where inverse kinematics holds them; what the sensor measures is derived from the pose.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from asbuilt.arrays import Array
from asbuilt.description import Frame, RobotModel
from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, read_recording
from asbuilt.experiment.free_base.base_checks import check_free_base
from asbuilt.experiment.free_base.columns import base_rotations

from .test_free_base import biped, log  # noqa: F401 - fixtures

POSE = [f"base_{axis}" for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]
PLACEMENT = np.eye(4)
PLACEMENT[:3, :3] = Rotation.from_euler("xyz", [0.1, -0.2, np.pi / 2]).as_matrix()
PLACEMENT[:3, 3] = -0.05, 0.02, 0.04


@pytest.fixture(scope="module")
def pose(biped: RobotModel, log: dict[str, Array]) -> Recording:  # noqa: F811
    return read_recording(log, model=biped)


@pytest.fixture(scope="module")
def sensed(pose: Recording, log: dict[str, Array]) -> dict[str, Array]:  # noqa: F811
    """The log with a sensor at PLACEMENT in place of the pose and velocities of the base."""
    t, R = pose.t, base_rotations(pose.q)
    place = pose.q[:, :3] + R @ PLACEMENT[:3, 3]
    turn = R @ PLACEMENT[:3, :3]
    acceleration = np.gradient(np.gradient(place, t, axis=0), t, axis=0)
    force = np.einsum("sji,sj->si", turn, acceleration + np.array([0.0, 0.0, 9.81]))
    spin = np.einsum("sji,sjk->sik", turn, np.gradient(turn, t, axis=0))
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    quaternion = Rotation.from_matrix(turn).as_quat()
    rng = np.random.default_rng(4)
    force = force + 0.05 + 0.02 * rng.normal(size=force.shape)
    rates = rates + 0.003 + 0.002 * rng.normal(size=rates.shape)
    kept = {name: x for name, x in log.items() if not name.startswith("base_")}
    return (
        kept
        | {f"imu_w{axis}": rates[:, k] for k, axis in enumerate("xyz")}
        | {f"imu_a{axis}": force[:, k] for k, axis in enumerate("xyz")}
        | {f"imu_q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")}
    )


@pytest.fixture(scope="module")
def model(biped: RobotModel) -> RobotModel:  # noqa: F811
    return replace(biped, frames=(*biped.frames, Frame("imu", 5, PLACEMENT)))


def without_quaternion(columns: dict[str, Array]) -> dict[str, Array]:
    return {name: x for name, x in columns.items() if not name.startswith("imu_q")}


@pytest.mark.parametrize("turned", [True, False])
def test_base_is_that_of_the_pose(
    model: RobotModel, pose: Recording, sensed: dict[str, Array], turned: bool
) -> None:
    columns = sensed if turned else without_quaternion(sensed)
    found = read_recording(columns, model=model)
    assert any("inertial sensor at imu" in note for note in found.notes)
    up, wanted = (base_rotations(x.q)[:, 2] for x in (found, pose))
    # An offset of 0.05 m/s^2 cannot be told from a tilt of 0.3 deg without a quaternion.
    assert np.abs(up - wanted).max() < (0.003 if turned else 0.015)
    assert found.qd is not None
    assert pose.qd is not None
    own, true = (np.einsum("sji,sj->si", base_rotations(x.q), x.qd[:, :3]) for x in (found, pose))
    assert np.sqrt(np.mean((own - true) ** 2)) < 0.2 * true.std()  # steps have kinks at 100 Hz
    assert not {each.code for each in check_free_base(model, found)}


def test_samples_that_were_lost_take_their_time(
    model: RobotModel, pose: Recording, sensed: dict[str, Array]
) -> None:
    """A fifth of the samples is lost in gaps of 0.1 s, over which the sensor is integrated."""
    kept = np.arange(pose.n_samples) % 50 < 40
    columns = {name: x[kept] for name, x in without_quaternion(sensed).items()}
    found = read_recording(columns, model=model)
    up, wanted = base_rotations(found.q)[:, 2], base_rotations(pose.q)[kept, 2]
    assert np.abs(up - wanted).max() < 0.015
    assert found.qd is not None
    assert pose.qd is not None
    own, true = (np.einsum("sji,sj->si", base_rotations(x.q), x.qd[:, :3]) for x in (found, pose))
    assert np.sqrt(np.mean((own - true[kept]) ** 2)) < 0.2 * true.std()


def test_the_pose_wins_where_both_are_logged(
    model: RobotModel,
    pose: Recording,
    sensed: dict[str, Array],
    log: dict[str, Array],  # noqa: F811
) -> None:
    both = read_recording(log | sensed, model=model)
    assert np.array_equal(both.q, pose.q)


def changed(columns: dict[str, Array], group: str, matrix: Array) -> dict[str, Array]:
    names = [f"imu_{group}{axis}" for axis in "xyz"]
    values = np.stack([columns[name] for name in names], axis=1) @ np.transpose(matrix)
    return columns | {name: values[:, k] for k, name in enumerate(names)}


def tilted(angle: float) -> Array:
    return Rotation.from_euler("x", angle).as_matrix()


@pytest.mark.parametrize(
    ("group", "matrix", "message"),
    [
        ("a", -np.eye(3), "the other sign"),
        ("a", np.eye(3) / 9.81, "they are in g"),
        ("a", 0.01 * np.eye(3), "gravity is taken out"),
        ("a", tilted(np.pi / 2), "of other axes"),
        ("w", np.rad2deg(1.0) * np.eye(3), "in deg/s"),
        ("w", -np.eye(3), "in other axes"),
        ("w", tilted(np.pi / 2), "in other axes"),
    ],
)
def test_other_readings_of_a_sensor_are_named(
    model: RobotModel, sensed: dict[str, Array], group: str, matrix: Array, message: str
) -> None:
    for columns in (sensed, without_quaternion(sensed)):
        with pytest.raises(RecordingError, match=message):
            read_recording(changed(columns, group, matrix), model=model)


def test_a_sensor_whose_frame_is_not_stated_is_named(
    biped: RobotModel,  # noqa: F811
    sensed: dict[str, Array],
) -> None:
    """Its axes are turned by 90 degrees against those of the base."""
    with pytest.raises(RecordingError, match="turned by 90 deg about the vertical"):
        read_recording(without_quaternion(sensed), model=biped)


def test_quaternions_of_a_sensor_are_checked(model: RobotModel, sensed: dict[str, Array]) -> None:
    names = [f"imu_q{axis}" for axis in "xyzw"]
    long = sensed | {name: 1.1 * sensed[name] for name in names}
    with pytest.raises(RecordingError, match=r"imu_qx imu_qy imu_qz imu_qw has length 1\.1"):
        read_recording(long, model=model)
    x, y, z, w = (sensed[name] for name in names)
    inverse = sensed | dict(zip(names, (-x, -y, -z, w), strict=True))
    with pytest.raises(RecordingError, match="the inverse"):
        read_recording(inverse, model=model)


def test_missing_columns_and_shifted_flags(model: RobotModel, sensed: dict[str, Array]) -> None:
    lacking = {name: x for name, x in sensed.items() if name != "imu_ay"}
    with pytest.raises(RecordingError, match="no column 'imu_ay'"):
        read_recording(lacking, model=model)
    late = {name: np.roll(x, 5) if name.startswith("contact_") else x for name, x in sensed.items()}
    found = read_recording(late, model=model)
    assert "contact_timing" in {each.code for each in check_free_base(model, found)}


@pytest.mark.parametrize("column", ["imu_wx", "imu_qx"])
def test_a_missing_value_of_a_sensor_is_told(
    model: RobotModel, sensed: dict[str, Array], column: str
) -> None:
    lost = np.where(np.arange(sensed[column].size) == 50, np.nan, sensed[column])
    with pytest.raises(RecordingError, match="missing values"):
        read_recording(sensed | {column: lost}, model=model)


def test_a_frame_that_is_not_there_is_refused_whether_it_is_needed_or_not(
    model: RobotModel,
    sensed: dict[str, Array],
    log: dict[str, Array],  # noqa: F811
) -> None:
    for columns in (sensed, log):
        with pytest.raises(RecordingError, match="the frame 'chest' is not fixed to the base"):
            read_recording(columns, model=model, sheet={"imu_frame": "chest"})
