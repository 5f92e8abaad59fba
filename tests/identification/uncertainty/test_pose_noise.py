"""Noise of a pose makes bodies light, but for the scores that it lends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import load_robot
from asbuilt.dynamics import find_base_parameters, inverse_dynamics
from asbuilt.dynamics.drives.drive_set import NO_DRIVE
from asbuilt.experiment import Recording, SignalChain, prepare_samples
from asbuilt.identification.information.square_root_information import accumulate
from asbuilt.identification.uncertainty.pose_noise import expect_pose_noise

BODY = """<inertial><origin xyz=".02 .01 -.05"/><mass value="{}"/>
  <inertia ixx=".03" ixy="0" ixz="0" iyy=".02" iyz="0" izz=".04"/></inertial>"""
URDF = f"""<robot name="flyer"><link name="trunk">{BODY.format(4)}</link>
  <link name="arm">{BODY.format(1)}</link><link name="tip"/>
  <joint name="a" type="continuous"><parent link="trunk"/><child link="arm"/>
    <origin xyz="0 .1 0"/><axis xyz="0 1 0"/></joint>
  <joint name="b" type="fixed"><parent link="arm"/><child link="tip"/></joint></robot>"""
NOISE = 2e-4
"""Standard deviation of the pose [m, rad]."""


def test_masses_keep_their_size_where_the_pose_is_noisy(tmp_path: Path) -> None:
    """In free fall, where nothing but noise accelerates against gravity, mass would vanish."""
    (tmp_path / "flyer.urdf").write_text(URDF)
    model = load_robot(tmp_path / "flyer.urdf", base="free", contacts="tip:0")
    base = find_base_parameters(model, NO_DRIVE)
    t, rng = np.arange(0.0, 40.0, 0.002), np.random.default_rng(0)
    f, phase = rng.uniform(0.3, 1.5, (2, 7)), rng.uniform(0.0, 6.0, (2, 7))
    w = 2.0 * np.pi * f
    size = np.array([0.01, 0.01, 0.01, 0.2, 0.2, 0.2, 0.5])
    q, qd, qdd = np.zeros((3, t.size, 7))
    for k in range(2):
        angle = np.outer(t, w[k]) + phase[k]
        q += size * np.sin(angle)
        qd += size * w[k] * np.cos(angle)
        qdd -= size * w[k] ** 2 * np.sin(angle)
    qdd[:, 2] -= 9.81
    qd[:, 2] -= 9.81 * t
    q[:, 2] -= 4.905 * t**2
    tau = inverse_dynamics(model, q, qd, qdd)
    q[:, :6] += NOISE * rng.standard_normal((t.size, 6))
    still = np.zeros((t.size, 1))
    recording = Recording(
        t=t, q=q, tau=tau, contact=still, joint_names=model.joint_names, torque_source="motor"
    )
    samples = prepare_samples(recording, SignalChain(cutoff=24.0, rests=True))
    information = accumulate(model, base, samples)
    true = base.values(model.parameters)

    def error(beta: Array) -> float:
        moved = information.stacked()[:, :-1] @ (beta - true)
        return float(np.linalg.norm(moved) / np.linalg.norm(information.stacked()[:, :-1] @ true))

    corrected, expected, growth = expect_pose_noise(model, base, [samples], information)
    plain = np.linalg.lstsq(
        information.stacked()[:, :-1], information.stacked()[:, -1], rcond=None
    )[0]
    assert expected is not None
    assert np.all((growth >= 1.0) & (growth <= 6.0))
    assert error(corrected) < 0.3 * error(plain)
    total = base.names.index(next(name for name in base.names if name.startswith("m6")))
    assert plain[total] < 0.97 * true[total]
    assert corrected[total] == pytest.approx(true[total], rel=0.01)
    # Scaled back, a random error of the mass grows as the mass does.
    assert growth[total] == pytest.approx(corrected[total] / plain[total], rel=0.02)
