"""Robots with a free base against Pinocchio's free flyer: torques, contacts, base parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics import (
    RegressorPlan,
    find_base_parameters,
    inverse_dynamics,
    observation_matrix,
)
from asbuilt.dynamics.reactions import Reactions, contact_basis, contact_jacobians
from asbuilt.errors import DescriptionError, UsageError
from asbuilt.experiment.free_base.columns import (
    base_rotations,
    coordinate_accelerations,
    coordinate_rates,
    yaw_pitch_roll,
)

pin = pytest.importorskip("pinocchio")

FEET = "left_foot,right_foot"
WALKER = """
<robot name="walker">
  <link name="trunk"><inertial><origin xyz="0.01 -0.02 0.03"/><mass value="4"/>
    <inertia ixx=".05" ixy=".002" ixz="-.001" iyy=".04" iyz=".003" izz=".06"/></inertial></link>
  {legs}
</robot>
"""
LEG = """
  <link name="{s}_thigh"><inertial><origin xyz="0 {y}.01 -0.1"/><mass value="0.8"/>
    <inertia ixx=".004" ixy="0" ixz=".0002" iyy=".003" iyz="0" izz=".001"/></inertial></link>
  <link name="{s}_shank"><inertial><origin xyz="0.02 0 -0.12"/><mass value="0.3"/>
    <inertia ixx=".002" ixy="0" ixz="0" iyy=".002" iyz=".0001" izz=".0005"/></inertial></link>
  <link name="{s}_foot"/>
  <joint name="{s}_hip" type="revolute"><parent link="trunk"/><child link="{s}_thigh"/>
    <origin xyz="0.05 {y}.1 -0.02" rpy="0 0.1 0"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
  <joint name="{s}_knee" type="revolute"><parent link="{s}_thigh"/><child link="{s}_shank"/>
    <origin xyz="0 0 -0.2"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="9" velocity="9"/></joint>
  <joint name="{s}_ankle" type="fixed"><parent link="{s}_shank"/><child link="{s}_foot"/>
    <origin xyz="0.01 0 -0.22"/></joint>
"""
URDF = WALKER.format(legs=LEG.format(s="left", y="0") + LEG.format(s="right", y="-0"))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("walker") / "walker.urdf"
    file.write_text(URDF)
    return file


@pytest.fixture(scope="module")
def walker(path: Path) -> RobotModel:
    return load_robot(path, base="free", contacts=FEET)


class Flyer:
    """Random states of one robot, for Pinocchio's free flyer and in our coordinates."""

    def __init__(self, path: Path, count: int = 20) -> None:
        self.model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
        self.data = self.model.createData()
        rng = np.random.default_rng(3)
        n = self.model.nv - 6
        quaternion = rng.normal(size=(count, 4)) * [0.3, 0.3, 1.0, 1.0]
        quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
        position, joints = rng.normal(size=(count, 3)), rng.uniform(-1, 1, (count, n))
        self.q = np.hstack([position, quaternion, joints])
        self.v, self.a = rng.normal(size=(2, count, n + 6))
        base = np.hstack([position, yaw_pitch_roll(quaternion)])
        self.ours = np.hstack([base, joints])
        rates = coordinate_rates(base, self.v[:, :3], self.v[:, 3:6])
        accelerations = coordinate_accelerations(
            base, rates, self.v[:, :3], self.v[:, 3:6], self.a[:, :3], self.a[:, 3:6]
        )
        self.rates = np.hstack([rates, self.v[:, 6:]])
        self.accelerations = np.hstack([accelerations, self.a[:, 6:]])

    def turned(self) -> Array:
        """What takes our rates to Pinocchio's velocities, (N, n, n)."""
        T = np.tile(np.eye(self.model.nv), (len(self.q), 1, 1))
        T[:, :3, :3] = np.swapaxes(base_rotations(self.ours), 1, 2)
        still = np.zeros((len(self.q), 3))
        for k, axis in enumerate(np.eye(3)):
            unit = coordinate_rates(self.ours, still, np.tile(axis, (len(self.q), 1)))
            T[:, 3:6, 3 + k] = unit[:, 3:]
        T[:, 3:6, 3:6] = np.linalg.inv(T[:, 3:6, 3:6])
        return T


@pytest.fixture(scope="module")
def flyer(path: Path) -> Flyer:
    return Flyer(path)


def test_rates_are_those_of_the_rotation(flyer: Flyer) -> None:
    """A step along the rates turns the base as its angular velocity does."""
    step = 1e-6
    ahead = base_rotations(flyer.ours + step * flyer.rates)
    for k, R in enumerate(base_rotations(flyer.ours)):
        expected = R @ pin.exp3(step * flyer.v[k, 3:6])
        assert np.allclose(ahead[k], expected, atol=1e-10)


def test_torques_are_pinocchios(walker: RobotModel, flyer: Flyer) -> None:
    """By virtual work the torques of the coordinates are `T^T tau`."""
    ours = inverse_dynamics(walker, flyer.ours, flyer.rates, flyer.accelerations)
    flyer.model.gravity.linear = walker.gravity
    for k, T in enumerate(flyer.turned()):
        tau = pin.rnea(flyer.model, flyer.data, flyer.q[k], flyer.v[k], flyer.a[k])
        assert np.allclose(ours[k], T.T @ tau, atol=1e-11)


def test_projected_rows_are_pinocchios(walker: RobotModel, flyer: Flyer) -> None:
    """Regressor and torque less contact forces, from Pinocchio's Jacobians and pseudo-inverse."""
    flyer.model.gravity.linear = walker.gravity
    closed = np.random.default_rng(5).integers(0, 2, (len(flyer.q), 2)).astype(float)
    tau = np.random.default_rng(6).normal(size=flyer.ours.shape)
    links = np.arange(50, 10 * walker.n_links)
    Y = observation_matrix(
        walker, flyer.ours, flyer.rates, flyer.accelerations, columns=links
    ).reshape(len(tau), walker.n_joints, -1)
    columns = np.moveaxis(Y, 2, 0)
    ours = [
        Reactions(closed).project_torque(walker, flyer.ours, np.ascontiguousarray(each))
        for each in (*columns, tau)
    ]
    order = [walker.joint_names.index(name) for name in flyer.model.names[2:]]
    for k, T in enumerate(flyer.turned()):
        Yp = pin.computeJointTorqueRegressor(
            flyer.model, flyer.data, flyer.q[k], flyer.v[k], flyer.a[k]
        )
        pin.computeJointJacobians(flyer.model, flyer.data, flyer.q[k])
        pin.updateFramePlacements(flyer.model, flyer.data)
        rows = [
            pin.getFrameJacobian(
                flyer.model, flyer.data, flyer.model.getFrameId(name), pin.LOCAL_WORLD_ALIGNED
            )[:3]
            for name, on in zip(FEET.split(","), closed[k], strict=True)
            if on
        ]
        J = np.vstack([np.zeros((1, len(T))), *rows]) @ T
        P = np.eye(len(T)) - np.linalg.pinv(J) @ J
        assert np.allclose(ours[-1][k], P @ tau[k], atol=1e-9)
        projected = P @ T.T @ Yp  # columns m, mx my mz, Ixx Ixy Iyy Ixz Iyz Izz of each body
        for body in range(len(flyer.model.inertias) - 1):
            link = 0 if body == 0 else order[body - 1] - 5
            for ours_at, theirs_at in enumerate((4, 5, 7, 6, 8, 9, 1, 2, 3, 0)):
                own = ours[10 * link + ours_at][k]
                assert np.allclose(own, projected[:, 10 * body + theirs_at], atol=1e-9)


def test_projection_takes_contact_forces_away(walker: RobotModel) -> None:
    rng = np.random.default_rng(7)
    q, forces = rng.uniform(-1, 1, (50, walker.n_joints)), rng.normal(size=(2, 50, 3))
    torque = sum(
        np.einsum("sij,si->sj", J, force)
        for J, force in zip(contact_jacobians(walker, q), forces, strict=True)
    )
    torque = np.asarray(torque)
    left = Reactions(np.ones((50, 2))).project_torque(walker, q, torque)
    assert np.abs(left).max() < 1e-13 * np.abs(torque).max() * 100
    again = Reactions(np.ones((50, 2))).project_torque(walker, q, left)
    assert np.allclose(again, left, atol=1e-14)
    kept = np.array(torque)
    torque.setflags(write=False)
    for k in (0, 7):  # the torques of one sample lie in one piece of memory
        one = Reactions(np.ones((1, 2))).project_torque(walker, q[k : k + 1], torque[k : k + 1])
        assert np.allclose(one, left[k], atol=1e-14)
    columns = Reactions(np.ones((50, 2))).project_torque(walker, q, np.asfortranarray(torque))
    assert np.array_equal(columns, left)
    assert np.array_equal(torque, kept)


def test_a_flat_contact_takes_moments_too(path: Path) -> None:
    flat = load_robot(path, base="free", contacts="left_foot:flat")
    q = np.random.default_rng(8).uniform(-1, 1, (9, flat.n_joints))
    assert np.linalg.matrix_rank(contact_jacobians(flat, q)[0][0]) == 6
    basis = contact_basis(flat, q, np.ones((9, 1)))
    assert np.allclose(np.einsum("ins,jns->sij", basis, basis), np.eye(6), atol=1e-12)


@pytest.mark.parametrize("count", [1, 7, 64, 129])
def test_rows_of_all_joints_are_zero_where_they_do_not_act(walker: RobotModel, count: int) -> None:
    """Every joint has all rows; those that its equation lacks are zero in any memory."""
    state = np.random.default_rng(9).normal(size=(3, count, walker.n_joints))
    plan = RegressorPlan.of(walker, spare_rows=1)
    buffer = plan.buffer(count)
    buffer[...] = np.nan
    rows = plan.evaluate(*state, buffer)
    expected = observation_matrix(walker, *state).reshape(count, walker.n_joints, -1)
    for k, own in enumerate(rows):
        assert np.array_equal(own[:-1].T, expected[:, k])


def test_all_ten_parameters_of_the_base_are_base_parameters(path: Path) -> None:
    """Ayusawa, Venture and Nakamura (2014): 10 of the trunk, 7 of each link on a turning joint.

    The numeric rank is found beside the structural one, and the call raises where they differ.
    """
    found = find_base_parameters(load_robot(path, base="free"))
    assert found.n_base == 10 + 7 * 4
    assert found.names[:10] == tuple(
        f"{name}6" for name in ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
    )
    total = found.expressions[found.names.index("m6")]
    assert total == "m6 + m7 + m8 + m9 + m10"


def test_base_wrench_alone_determines_all_base_parameters(walker: RobotModel) -> None:
    """Rows of the six unactuated equations have the rank of all rows."""
    base = find_base_parameters(walker)
    state = np.random.default_rng(10).normal(size=(3, 60, walker.n_joints))
    Y = observation_matrix(walker, *state, columns=base.columns).reshape(60, walker.n_joints, -1)
    six = Y[:, :6].reshape(-1, base.n_base)
    assert np.linalg.matrix_rank(six / np.linalg.norm(six, axis=0)) == base.n_base


def test_a_planar_base_has_fewer(path: Path) -> None:
    planar = load_robot(path, base="planar")
    assert planar.joint_names[:3] == ("base_x", "base_y", "base_yaw")
    assert find_base_parameters(planar).names[:3] == ("Izz3", "mx3", "my3")


def test_mjcf_gives_the_same_robot(walker: RobotModel) -> None:
    mujoco = pytest.importorskip("mujoco")
    text = """<mujoco model="two"><worldbody><body name="trunk" pos="0 0 1"><freejoint/>
      <inertial pos=".01 0 .02" mass="3" diaginertia=".03 .02 .04"/>
      <body name="leg" pos="0 .1 0"><joint name="hip" axis="0 1 0"/>
      <inertial pos="0 0 -.1" mass=".5" diaginertia=".003 .002 .001"/>
      <geom name="toe" type="sphere" size=".02" pos="0 0 -.2"/></body></body></worldbody>
      </mujoco>"""
    file = Path(walker.source).parent / "two.xml"
    file.write_text(text)
    model = load_robot(file, base="free", contacts="toe")
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    rng = np.random.default_rng(11)
    q, qd = rng.uniform(-1, 1, (2, 1, 7))
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, base_rotations(q)[0].ravel())
    d.qpos[:] = [*q[0, :3], *quaternion, q[0, 6]]
    # MuJoCo's free joint: velocity in world axes, angular velocity in base axes.
    w = np.linalg.solve(
        np.stack(
            [coordinate_rates(q, np.zeros((1, 3)), axis[None])[0, 3:] for axis in np.eye(3)]
        ).T,
        qd[0, 3:6],
    )
    d.qvel[:] = [*qd[0, :3], *w, qd[0, 6]]
    mujoco.mj_forward(m, d)
    assert d.qfrc_bias[:3] == pytest.approx(
        inverse_dynamics(model, q, qd, _without_rotation_change(q, qd, w))[0, :3],
        abs=1e-9,
    )


def _without_rotation_change(q: Array, qd: Array, w: Array) -> Array:
    """Accelerations of the coordinates for which the base's twist keeps its MuJoCo velocities."""
    R = base_rotations(q)
    v = np.einsum("sji,sj->si", R, qd[:, :3])
    a = -np.cross(w[None], v)
    found = coordinate_accelerations(q, qd[:, :6], v, w[None], a, np.zeros((1, 3)))
    return np.hstack([found, np.zeros((1, 1))])


def test_a_fixed_root_cannot_float(path: Path) -> None:
    with pytest.raises(DescriptionError, match="mass it does not give"):
        load_robot("two-link", base="free")
    with pytest.raises(UsageError, match="fixed root, where contacts"):
        load_robot(path, contacts="left_foot")
    with pytest.raises(DescriptionError, match="no moving link or frame 'toe'"):
        load_robot(path, base="free", contacts="toe")
