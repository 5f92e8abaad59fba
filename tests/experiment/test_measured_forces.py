"""Measured forces at feet and base against Pinocchio's external forces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import RecordingError
from asbuilt.experiment import read_recording
from asbuilt.experiment.free_base.base_checks import check_free_base
from asbuilt.experiment.free_base.columns import (
    ANGULAR,
    LINEAR,
    POSITION,
    QUATERNION,
    base_rotations,
    coordinate_accelerations,
    coordinate_rates,
)

pin = pytest.importorskip("pinocchio")

RATE, COUNT = 200.0, 400
FEET = ("left_foot", "right_foot")
URDF = """
<robot name="walker">
  <link name="trunk"><inertial><origin xyz="0.01 -0.02 0.03"/><mass value="4"/>
    <inertia ixx=".05" ixy=".002" ixz="-.001" iyy=".04" iyz=".003" izz=".06"/></inertial></link>
  {legs}
</robot>
"""
LEG = """
  <link name="{s}_thigh"><inertial><origin xyz="0 {y}.01 -0.1"/><mass value="0.8"/>
    <inertia ixx=".004" ixy="0" ixz=".0002" iyy=".003" iyz="0" izz=".001"/></inertial></link>
  <link name="{s}_foot"/>
  <joint name="{s}_hip" type="revolute"><parent link="trunk"/><child link="{s}_thigh"/>
    <origin xyz="0.05 {y}.1 -0.02" rpy="0 0.1 0"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
  <joint name="{s}_ankle" type="fixed"><parent link="{s}_thigh"/><child link="{s}_foot"/>
    <origin xyz="0.01 0 -0.22" rpy="0.3 -0.2 0.5"/></joint>
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("walker") / "walker.urdf"
    file.write_text(URDF.format(legs=LEG.format(s="left", y="0") + LEG.format(s="right", y="-0")))
    return file


class Forced:
    """A walker in smooth motion that is pushed at feet and base, torques by Pinocchio."""

    def __init__(self, path: Path) -> None:
        model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
        data, rng = model.createData(), np.random.default_rng(3)
        t = np.arange(COUNT) / RATE
        f, phase = rng.uniform(0.2, 0.6, (2, model.nv))
        phase = 9.0 * phase
        angle = 2.0 * np.pi * f * t[:, None] + phase
        ours = 0.3 * np.sin(angle)
        rates = 0.3 * 2.0 * np.pi * f * np.cos(angle)
        accelerations = -((2.0 * np.pi * f) ** 2) * ours
        R = base_rotations(ours)
        q = np.zeros((COUNT, model.nq))
        q[:, :3], q[:, 7:] = ours[:, :3], ours[:, 6:]
        q[:, 3:7] = [pin.Quaternion(each).coeffs() for each in R]
        self.columns = {"t": t}
        twist, change = _twists(ours, rates, accelerations)
        v, a = np.hstack([twist, rates[:, 6:]]), np.hstack([change, accelerations[:, 6:]])
        # Forces that together carry the robot, as if feet and base stood on plates.
        weight = 9.81 * sum(each.mass for each in model.inertias)
        wrenches = rng.normal(size=(3, COUNT, 6)) * [4.0, 4.0, 4.0, 0.5, 0.5, 0.5]
        tau = np.zeros((COUNT, model.nv))
        frames = [model.getFrameId(name) for name in (*FEET, "trunk")]
        for k in range(COUNT):
            pin.forwardKinematics(model, data, q[k])
            pin.updateFramePlacements(model, data)
            up = np.array([0.0, 0.0, weight / 3.0])
            external = [pin.Force.Zero() for _ in range(model.njoints)]
            for frame, wrench in zip(frames, wrenches, strict=True):
                wrench[k, :3] += data.oMf[frame].rotation.T @ up
                own = model.frames[frame]
                external[own.parentJoint] += own.placement.act(pin.Force(wrench[k]))
            whole = pin.StdVec_Force()
            whole.extend(external)
            tau[k] = pin.rnea(model, data, q[k], v[k], a[k], whole)
        # What is missing at the base is a fourth force that is measured there as well.
        wrenches[2] += tau[:, :6]
        self.joints = [*model.names[2:]]
        names = ("contact_left_foot", "contact_right_foot", "base")
        for columns, values in (
            (POSITION, q[:, :3]),
            (QUATERNION, q[:, 3:7]),
            (LINEAR, v[:, :3]),
            (ANGULAR, v[:, 3:6]),
            ([f"q_{name}" for name in self.joints], q[:, 7:]),
            ([f"qd_{name}" for name in self.joints], v[:, 6:]),
            ([f"tau_{name}" for name in self.joints], tau[:, 6:]),
            *(
                ([f"{name}_{axis}" for axis in ("fx", "fy", "fz", "mx", "my", "mz")], wrench)
                for name, wrench in zip(names, wrenches, strict=True)
            ),
        ):
            self.columns |= dict(zip(columns, values.T, strict=True))
        self.state = ours, rates, accelerations


def _twists(q: Array, rates: Array, accelerations: Array) -> tuple[Array, Array]:
    """Twist and its rate (N, 6) in base axes, by solving what is linear in them."""
    still = np.zeros((len(q), 3))
    unit = np.stack(
        [
            coordinate_rates(q, *np.split(np.tile(axis, (len(q), 1)), 2, axis=1))
            for axis in np.eye(6)
        ],
        axis=2,
    )
    twist = np.linalg.solve(unit, rates[:, :6, None])[:, :, 0]
    v, w = twist[:, :3], twist[:, 3:]
    rest = coordinate_accelerations(q, rates[:, :6], v, w, still, still)
    change = np.linalg.solve(unit, (accelerations[:, :6] - rest)[:, :, None])[:, :, 0]
    return twist, change


@pytest.fixture(scope="module")
def forced(path: Path) -> Forced:
    return Forced(path)


def walker(path: Path, contacts: str) -> RobotModel:
    return load_robot(path, base="free", contacts=contacts)


@pytest.mark.parametrize("contacts", [",".join(FEET), "left_foot:flat,right_foot:flat"])
def test_measured_wrenches_are_external_forces_of_pinocchio(
    path: Path, forced: Forced, contacts: str
) -> None:
    """With every force known the equations hold as they are, and nothing is projected away."""
    model = walker(path, contacts)
    recording = read_recording(forced.columns, model=model)
    assert np.allclose(recording.tau, inverse_dynamics(model, *forced.state), atol=1e-9)
    assert not np.any(recording.contact)
    assert "force_axes" not in {each.code for each in check_free_base(model, recording)}


def test_a_force_without_moments_acts_below_the_ball(path: Path, forced: Forced) -> None:
    """A force at the lowest point is a force at the centre and a moment, both known to Pinocchio.

    That of the ball's radius in axes of the world is `r z x f`, with the sign of what acts there.
    """
    model = walker(path, "left_foot:0.05,right_foot:0.05")
    with_moments = read_recording(forced.columns, model=model)
    log = dict(forced.columns)
    for foot in FEET:
        f = np.stack([log[f"contact_{foot}_f{axis}"] for axis in "xyz"], axis=1)
        link, placement = model.placed(foot)
        up = np.einsum("sji,j->si", _turns(model, forced, link) @ placement[:3, :3], [0, 0, 0.05])
        m = np.cross(-up, f)
        for k, axis in enumerate("xyz"):
            log[f"contact_{foot}_m{axis}"] = m[:, k]
    expected = read_recording(log, model=model).tau
    for foot in FEET:
        for axis in "xyz":
            del log[f"contact_{foot}_m{axis}"]
    assert np.allclose(read_recording(log, model=model).tau, expected, atol=1e-9)
    assert not np.allclose(expected, with_moments.tau, atol=1e-3)


def _turns(model: RobotModel, forced: Forced, link: int) -> Array:
    """Turn a link about x from the base, as its hip does: R of the base, then rpy, then x."""
    k = model.joint_names.index(model.joint_names[link])
    c, s = np.cos(forced.state[0][:, k]), np.sin(forced.state[0][:, k])
    turn = np.tile(np.eye(3), (COUNT, 1, 1))
    turn[:, 1, 1], turn[:, 1, 2], turn[:, 2, 1], turn[:, 2, 2] = c, -s, s, c
    mounted = np.array(pin.rpy.rpyToMatrix(0.0, 0.1, 0.0))
    return base_rotations(forced.state[0]) @ mounted @ turn


def test_a_force_without_a_value_is_projected_away_again(path: Path, forced: Forced) -> None:
    model = walker(path, ",".join(FEET))
    lost = forced.columns["contact_left_foot_fy"].copy()
    lost[100:120] = np.nan
    recording = read_recording(forced.columns | {"contact_left_foot_fy": lost}, model=model)
    assert recording.contact is not None
    assert np.all(recording.contact[100:120, 0] == 1.0)
    assert recording.contact.sum() == 20
    assert np.all(np.isfinite(recording.tau))


@pytest.mark.parametrize("reading", ["world", "sign"])
def test_forces_in_world_axes_or_of_other_sign_are_found(
    path: Path, forced: Forced, reading: str
) -> None:
    model = walker(path, ",".join(FEET))
    log = dict(forced.columns)
    for foot in FEET:
        names = [f"contact_{foot}_f{axis}" for axis in "xyz"]
        f = np.stack([log[name] for name in names], axis=1)
        if reading == "world":
            link, placement = model.placed(foot)
            R = _turns(model, forced, link) @ placement[:3, :3]
            f = np.einsum("sij,sj->si", R, f)
        else:
            f = -f
        log |= dict(zip(names, f.T, strict=True))
    names = [f"base_f{axis}" for axis in "xyz"]
    f = np.stack([log[name] for name in names], axis=1)
    world = np.einsum("sij,sj->si", base_rotations(forced.state[0]), f)
    log |= dict(zip(names, (world if reading == "world" else -f).T, strict=True))
    found = check_free_base(model, read_recording(log, model=model))
    (finding,) = (each for each in found if each.code == "force_axes")
    assert ("in world axes" in finding.message) == (reading == "world")
    assert ("of the robot on" in finding.message) == (reading == "sign")


def test_flags_that_disagree_with_forces_are_found(path: Path, forced: Forced) -> None:
    model = walker(path, ",".join(FEET))
    flags = {f"contact_{foot}": np.ones(COUNT) for foot in FEET}
    flags["contact_left_foot"][: COUNT // 4] = 0.0
    found = check_free_base(model, read_recording(forced.columns | flags, model=model))
    (finding,) = (each for each in found if each.code == "contact_force_flags")
    assert "contact_left_foot" in finding.message


def test_a_part_of_a_force_is_refused_by_name(path: Path, forced: Forced) -> None:
    model = walker(path, "left_foot:flat,right_foot")
    for name in ("contact_left_foot_mz", "contact_right_foot_fy"):
        rest = {key: values for key, values in forced.columns.items() if key != name}
        with pytest.raises(RecordingError, match=f"but no {name}"):
            read_recording(rest, model=model)
