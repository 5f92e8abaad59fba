"""Logs of a robot with a free base: what is read, and what is wrong with them, by name.

The robot is a trunk on two legs whose feet stand where inverse kinematics holds them, so that pose,
joints, velocities and contact flags agree to the last digit; each test spoils one of them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, load_robot
from asbuilt.dynamics import link_poses
from asbuilt.dynamics.reactions import contact_jacobians
from asbuilt.errors import RecordingError
from asbuilt.experiment import (
    check_recording,
    prepare_samples,
    read_fitted_recordings,
    read_recording,
)
from asbuilt.experiment.free_base.base_checks import check_free_base
from asbuilt.experiment.free_base.columns import base_rotations

LEGS = "".join(
    f"""
  <link name="{s}1"><inertial><mass value=".4"/>
    <inertia ixx=".001" ixy="0" ixz="0" iyy=".001" iyz="0" izz=".001"/></inertial></link>
  <link name="{s}2"><inertial><mass value=".4"/>
    <inertia ixx=".001" ixy="0" ixz="0" iyy=".001" iyz="0" izz=".001"/></inertial></link>
  <link name="{s}3"><inertial><mass value=".2"/>
    <inertia ixx=".001" ixy="0" ixz="0" iyy=".001" iyz="0" izz=".001"/></inertial></link>
  <link name="{s}_foot"/>
  <joint name="{s}_a" type="continuous"><parent link="trunk"/><child link="{s}1"/>
    <origin xyz="0 {y} 0"/><axis xyz="1 0 0"/></joint>
  <joint name="{s}_b" type="continuous"><parent link="{s}1"/><child link="{s}2"/>
    <origin xyz="0 0 -.02"/><axis xyz="0 1 0"/></joint>
  <joint name="{s}_c" type="continuous"><parent link="{s}2"/><child link="{s}3"/>
    <origin xyz="0 0 -.2"/><axis xyz="0 1 0"/></joint>
  <joint name="{s}_d" type="fixed"><parent link="{s}3"/><child link="{s}_foot"/>
    <origin xyz="0 0 -.2"/></joint>"""
    for s, y in (("l", 0.1), ("r", -0.1))
)
URDF = f"""<robot name="biped"><link name="trunk"><inertial><mass value="4"/>
  <inertia ixx=".05" ixy="0" ixz="0" iyy=".04" iyz="0" izz=".06"/></inertial></link>{LEGS}
  </robot>"""
RATE, PERIOD = 100.0, 0.8


@pytest.fixture(scope="module")
def biped(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    file = tmp_path_factory.mktemp("biped") / "biped.urdf"
    file.write_text(URDF)
    return load_robot(file, base="free", contacts="l_foot,r_foot")


@pytest.fixture(scope="module")
def log(biped: RobotModel) -> dict[str, Array]:
    """Columns of a robot that steps from foot to foot while its trunk sways and turns."""
    t = np.arange(0.0, 12.0, 1.0 / RATE)
    sway = np.stack([np.sin((1.1 + 0.37 * k) * t + k) for k in range(6)], axis=1)
    q = np.zeros((t.size, 12))
    q[:, :6] = sway * [0.03, 0.03, 0.02, 0.1, 0.08, 0.08] + [0.0, 0.0, 0.34, 1.2, 0.1, 0.0]
    step = np.sin(2.0 * np.pi * t / PERIOD)
    lift = 0.06 * np.maximum([step, -step], 0.0).T
    turn = np.array([[np.cos(1.2), -np.sin(1.2)], [np.sin(1.2), np.cos(1.2)]])
    q[:, 6:] = [0.0, 0.5, -1.0, 0.0, 0.5, -1.0]
    for _ in range(12):
        poses = link_poses(biped, q)
        gap, J = [], []
        for leg, (contact, jacobian) in enumerate(
            zip(biped.contacts, contact_jacobians(biped, q), strict=True)
        ):
            link, place = biped.placed(contact.frame)
            goal = np.tile(turn @ [0.02, 0.1 - 0.2 * leg], (t.size, 1))
            at = (poses[:, link] @ place)[:, :3, 3]
            gap.append(np.column_stack([goal, lift[:, leg]]) - at)
            J.append(jacobian[:, :, 6:])
        q[:, 6:] += np.linalg.solve(np.concatenate(J, axis=1), np.hstack(gap)[:, :, None])[:, :, 0]
    assert np.abs(gap).max() < 1e-12
    q[:, 6:] = np.unwrap(q[:, 6:], axis=0)
    rates = np.gradient(q, t, axis=0)
    R = base_rotations(q)
    turning = np.einsum("sji,sjk->sik", R, np.gradient(R, t, axis=0))
    w = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
    v = np.einsum("sji,sj->si", R, rates[:, :3])
    half = q[:, 3:6] / 2.0
    (cy, cp, cr), (sy, sp, sr) = np.cos(half).T, np.sin(half).T
    quaternion = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    noise = np.random.default_rng(1).normal(size=(t.size, 6))
    return (
        {"t": t}
        | {f"base_{axis}": q[:, k] for k, axis in enumerate("xyz")}
        | {f"base_q{axis}": each for axis, each in zip("xyzw", quaternion, strict=True)}
        | {f"base_v{axis}": v[:, k] for k, axis in enumerate("xyz")}
        | {f"base_w{axis}": w[:, k] for k, axis in enumerate("xyz")}
        | {f"q_{name}": q[:, 6 + k] for k, name in enumerate(biped.joint_names[6:])}
        | {f"qd_{name}": rates[:, 6 + k] for k, name in enumerate(biped.joint_names[6:])}
        | {f"tau_{name}": noise[:, k] for k, name in enumerate(biped.joint_names[6:])}
        | {
            f"contact_{each.frame}": (lift[:, k] == 0.0).astype(float)
            for k, each in enumerate(biped.contacts)
        }
    )


def codes(model: RobotModel, columns: dict[str, Array]) -> set[str]:
    recording = read_recording(columns, model=model)
    return {
        each.code
        for each in check_free_base(model, recording)
        if each.severity in ("error", "warning")
    }


def test_a_log_that_agrees_has_no_findings(biped: RobotModel, log: dict[str, Array]) -> None:
    recording = read_recording(log, model=biped)
    assert recording.joint_names[:6] == biped.joint_names[:6]
    assert recording.qd is not None
    assert np.allclose(recording.qd, np.gradient(recording.q, recording.t, axis=0), atol=1e-3)
    assert recording.has_torque.all()
    assert not codes(biped, log)
    assert read_fitted_recordings(biped, [log])[0].contacts == biped.contacts  # points do not roll
    assert "base_velocity_axes" not in check_recording(biped, recording).codes


def test_velocities_in_world_axes_are_found(biped: RobotModel, log: dict[str, Array]) -> None:
    R = base_rotations(read_recording(log, model=biped).q)
    for group in ("v", "w"):
        names = [f"base_{group}{axis}" for axis in "xyz"]
        world = np.einsum("sij,sj->si", R, np.stack([log[name] for name in names], axis=1))
        wrong = log | {name: world[:, k] for k, name in enumerate(names)}
        assert codes(biped, wrong) == {"base_velocity_axes"}
        check = check_recording(biped, read_recording(wrong, model=biped))
        assert [f.code for f in check.errors] == ["base_velocity_axes"]


@pytest.mark.parametrize("order", ["wxyz", "inverse"])
def test_other_quaternions_are_found(biped: RobotModel, log: dict[str, Array], order: str) -> None:
    x, y, z, w = (log[f"base_q{axis}"] for axis in "xyzw")
    other = (w, x, y, z) if order == "wxyz" else (-x, -y, -z, w)
    wrong = log | dict(zip([f"base_q{axis}" for axis in "xyzw"], other, strict=True))
    try:
        found = codes(biped, wrong)
    except RecordingError as error:  # so read, the base may pitch beyond what has coordinates
        found = {"quaternion_order"} if "base_qx, qy, qz and qw" in str(error) else set()
    assert "quaternion_order" in found


@pytest.mark.parametrize("late", [-0.05, 0.05])
def test_shifted_contacts_are_found(biped: RobotModel, log: dict[str, Array], late: float) -> None:
    wrong = log | {
        name: np.roll(values, round(late * RATE))
        for name, values in log.items()
        if name.startswith("contact_")
    }
    (finding,) = (
        each
        for each in check_free_base(biped, read_recording(wrong, model=biped))
        if each.code == "contact_timing"
    )
    assert finding.severity == "error"
    assert f"50 ms {'late' if late > 0 else 'early'}" in finding.message


def test_contacts_that_never_close_are_found(biped: RobotModel, log: dict[str, Array]) -> None:
    none = log | {name: 0.0 * log[name] for name in log if name.startswith("contact_")}
    found = check_free_base(biped, read_recording(none, model=biped))
    assert [(each.code, each.severity) for each in found] == [("contact_never_closes", "error")]
    one = log | {"contact_l_foot": 0.0 * log["t"]}
    assert "contact_never_closes" in codes(biped, one)


def test_a_base_that_falls_needs_no_contact(biped: RobotModel, log: dict[str, Array]) -> None:
    t = log["t"]
    falling = log | {name: 0.0 * log[name] for name in log if name.startswith("contact_")}
    falling = {k: v for k, v in falling.items() if k[:6] not in ("base_v", "base_w")}
    falling["base_z"] = log["base_z"] - 0.5 * 9.81 * t**2
    assert not codes(biped, falling)


def test_a_foot_that_slips_is_found(biped: RobotModel, log: dict[str, Array]) -> None:
    always = log | {name: 1.0 + 0.0 * log[name] for name in log if name.startswith("contact_")}
    assert "contact_slips" in codes(biped, always)


def test_quaternions_without_unit_length_are_refused(
    biped: RobotModel, log: dict[str, Array]
) -> None:
    with pytest.raises(RecordingError, match=r"base_qx .* has length 1\.3 at sample"):
        read_recording(log | {f"base_q{a}": 1.3 * log[f"base_q{a}"] for a in "xyzw"}, model=biped)
    near = {f"base_q{a}": 1.005 * log[f"base_q{a}"] for a in "xyzw"}
    read = read_recording(log | near, model=biped)
    assert any("quaternions were normalised" in note for note in read.notes)
    assert np.allclose(read.q, read_recording(log, model=biped).q, atol=1e-12)


def test_a_clock_that_stands_is_left_to_the_checks(
    biped: RobotModel, log: dict[str, Array]
) -> None:
    """Feet are looked at before the clock is checked, and must not stumble over it."""
    stopped = log | {"t": 0.0 * log["t"]}
    model, (recordings,) = read_fitted_recordings(biped, ([stopped],))
    assert not check_recording(model, recordings[0]).ok


@pytest.mark.parametrize("column", ["base_z", "base_qw", "contact_r_foot"])
def test_a_missing_column_is_named(biped: RobotModel, log: dict[str, Array], column: str) -> None:
    rest = {name: values for name, values in log.items() if name != column}
    with pytest.raises(RecordingError, match=f"no column '{column}'"):
        read_recording(rest, model=biped)


def test_contacts_count_as_closed_while_filters_spread_them(
    biped: RobotModel, log: dict[str, Array], tmp_path: Path
) -> None:
    recording = read_recording(log, model=biped)
    samples = prepare_samples(recording)
    closed = samples.reactions.contact
    assert closed is not None
    assert recording.contact is not None
    own = recording.contact[np.searchsorted(recording.t, samples.t)]
    assert np.all(closed >= own)
    assert closed.mean() > own.mean()
    half = samples.select(np.arange(samples.n_samples) % 400 < 200)
    assert half.reactions.n_samples == half.n_samples
