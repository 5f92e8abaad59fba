"""Robots with many drive terms.

What each file carries of them, and that its torques are those of the result.
"""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reload_oracle import as_if_identified, mujoco_torques
from test_export import call, result_of

from asbuilt.description import DriveValues, RobotModel, bundled_robot, load_robot
from asbuilt.dynamics import (
    DriveSet,
    described_drive,
    drive_torque,
    find_base_parameters,
    inverse_dynamics,
    parameter_names,
)
from asbuilt.errors import DescriptionError, InertiaError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot
from asbuilt.identification import IdentificationResult
from asbuilt.validation.prediction import derive_cad_values
from asbuilt.writers import export_result
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.mjcf import export_mjcf
from asbuilt.writers.models.robot_toml import format_robot_toml
from studied_cases import first_of

PER_JOINT = "/".join(f"{0.02 + 0.01 * k:.2f}" for k in range(7))
RICH = {
    "kuka-iiwa7-r800": (
        f"asymmetric_viscous,asymmetric_coulomb,stribeck:velocity={PER_JOINT}:power=1.5,spring:joints=2/6,cubic,power:exponent=0.6,load_friction"
    ),
    "ur10e": (
        "armature,motor_armature,viscous,motor_viscous,coulomb,motor_coulomb,quadratic,smooth_coulomb:width=0.05,balancer:joints=2,offset"
    ),
    "scara": (
        "armature,viscous,coulomb,smooth_coulomb:width=0.3/0.2/0.1/0.4,stribeck:velocity=0.1,spring,offset"
    ),
}


def coupled(model: RobotModel) -> RobotModel:
    """Return a six-axis arm whose wrist motors turn with each other, with gears."""
    T = np.eye(6)
    T[4, 3], T[5, 3], T[5, 4] = 0.1, -0.2, 1.0
    geared = tuple(replace(joint, drive=DriveValues(gear_ratio=101.0)) for joint in model.joints)
    return replace(model, joints=geared, motor_coupling=T)


def rich_result(name: str) -> IdentificationResult:
    """Return a result with random positive drive parameters of its rich set."""
    model = coupled(bundled_robot(name)) if name == "ur10e" else bundled_robot(name)
    bodies = as_if_identified(model, 2, drives=False)
    result = result_of(model, bodies, drive=RICH[name], variance=1e-20)
    rng = np.random.default_rng(3)
    chi = np.concatenate(
        [bodies.parameters, rng.uniform(0.1, 1.0, result.base.n_standard - 10 * model.n_joints)]
    )
    values = result.base.values(chi)
    return replace(
        result,
        parameters=tuple(
            replace(p, estimate=float(v)) for p, v in zip(result.parameters, values, strict=True)
        ),
    )


def torques_of(
    result: IdentificationResult, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Predict as `predict_torque` does.

    Kept columns alone, drives from the rigid-body torque of these.
    """
    rigid = 10 * result.model.n_joints
    chi = np.zeros(result.n_standard)
    chi[result.base.columns] = result.estimates
    load = inverse_dynamics(result.model, q, qd, qdd, parameters=chi[:rigid])
    return load + drive_torque(
        result.base.drive, chi[rigid:], q, qd, qdd, load=load, shares=result.model.motor_shares
    )


@pytest.mark.parametrize("name", [*RICH])
def test_robot_file_gives_the_torques_of_the_result(name: str, tmp_path: Path) -> None:
    result = rich_result(name)
    exported = export_result(result, toml=tmp_path / "robot.toml")
    assert "toml" not in exported.notes
    written = load_robot(exported.files["toml"])
    drive, _ = described_drive(written)
    assert drive.keys == result.base.drive.keys
    motion = random_fourier(result.model, rng=5, duration=2.0).sample(50.0)
    simulated = (
        VirtualRobot.ideal(written)
        .record(random_fourier(result.model, rng=5, duration=2.0), rate=50.0)
        .recording
    )
    expected = torques_of(result, motion.q, motion.qd, motion.qdd)
    np.testing.assert_allclose(simulated.tau, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        derive_cad_values(result, written), result.estimates, rtol=0, atol=1e-9
    )
    assert [joint.drive.gear_ratio for joint in written.joints] == [
        joint.drive.gear_ratio for joint in result.model.joints
    ]


@pytest.mark.parametrize("name", first_of(1, [*RICH]))
def test_c_code_carries_every_term(name: str, tmp_path: Path) -> None:
    result = rich_result(name)
    source = export_result(result, c=tmp_path / "robot.c").files["c"]
    q, qd, qdd = draw_sample_states(result.model, 20)
    qd[:5] *= 0.02
    qd[0, :2] = 0.0
    prefix = result.robot.replace("-", "_")
    states = ",\n".join(
        f"{{{', '.join(map(repr, row))}}}" for row in np.hstack([q, qd, qdd]).tolist()
    )
    n, p = result.model.n_joints, result.n_base
    (tmp_path / "main.c").write_text(f"""#include "robot.h"
#include <stdio.h>
static const double s[20][{3 * n}] = {{
{states}
}};
int main(void) {{
    for (int k = 0; k < 20; k++) {{
        double tau[{n}], Y[{n * p}];
        {prefix}_inverse_dynamics(s[k], s[k] + {n}, s[k] + {2 * n}, tau);
        {prefix}_regressor(s[k], s[k] + {n}, s[k] + {2 * n}, Y);
        for (int j = 0; j < {n}; j++) {{
            double linear = 0.0;
            for (int i = 0; i < {p}; i++) linear += Y[j*{p} + i]*{prefix}_base_values[i];
            printf("%.17g %.17g\\n", tau[j], linear);
        }}
    }}
    return 0;
}}
""")
    program = tmp_path / "main"
    subprocess.run(
        [
            "gcc",
            "-std=c99",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-pedantic",
            str(tmp_path / "main.c"),
            str(source),
            "-o",
            str(program),
            "-lm",
        ],
        check=True,
    )
    printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    found = np.array([line.split() for line in printed.splitlines()], dtype=float).reshape(20, n, 2)
    expected = torques_of(result, q, qd, qdd)
    for column in (0, 1):
        np.testing.assert_allclose(found[:, :, column], expected, rtol=0, atol=1e-9)


def test_mujoco_has_what_it_can(tmp_path: Path) -> None:
    """Springs, asymmetric friction and coupled motors, as MuJoCo's own inverse dynamics finds them.

    Offsets as the actuators' bias.
    """
    model = coupled(bundled_robot("ur10e"))
    result = result_of(
        model,
        as_if_identified(model, 2, drives=False),
        drive="armature,motor_armature,viscous,motor_viscous,asymmetric_coulomb,motor_coulomb,spring,offset",
        variance=1e-20,
    )
    rng = np.random.default_rng(1)
    chi = np.concatenate(
        [
            as_if_identified(model, 2, drives=False).parameters,
            rng.uniform(0.2, 1.0, result.n_standard - 60),
        ]
    )
    values = result.base.values(chi)
    result = replace(
        result,
        parameters=tuple(
            replace(p, estimate=float(v)) for p, v in zip(result.parameters, values, strict=True)
        ),
    )
    exported = export_result(result, mjcf=tmp_path / "robot.xml")
    assert len(exported.notes["mjcf"]) == 1
    q, qd, qdd = draw_sample_states(model, 20)
    qd = np.where(np.abs(qd) < 0.3, 0.3 * np.sign(qd) + 0.1, qd)
    moving = np.all(np.abs(qd @ model.motor_shares.T)[:, 4:] > 0.05, axis=1)
    q, qd, qdd = q[moving], qd[moving], qdd[moving]
    expected = torques_of(result, q, qd, qdd)
    text = exported.files["mjcf"].read_text()
    import mujoco

    compiled = mujoco.MjModel.from_xml_string(text)
    bias = compiled.actuator_biasprm[:, 0]
    found = mujoco_torques(text, model.joint_names, q, qd, qdd) - bias
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    data = mujoco.MjData(compiled)
    data.ctrl[:] = 1.0
    mujoco.mj_forward(compiled, data)
    np.testing.assert_allclose(data.qfrc_actuator, 1.0 + bias)
    assert np.any(bias != 0.0)


def test_what_a_file_leaves_out_is_said(tmp_path: Path) -> None:
    exported = export_result(
        rich_result("kuka-iiwa7-r800"), mjcf=tmp_path / "robot.xml", urdf=tmp_path / "robot.urdf"
    )
    said = " ".join(exported.notes["mjcf"])
    for key in ("stribeck", "cubic", "power", "load_friction", "asymmetric_viscous"):
        assert key in said
    assert "spring" not in said
    assert any("load_friction, spring (A2, A6): the" in note for note in exported.notes["urdf"])


def test_load_that_counts_an_armature_is_said(tmp_path: Path) -> None:
    """The base parameters have the armature of joint 1 in the inertia of link 1, and so in its
    load; the exported robot has it apart.
    """
    model = bundled_robot("kuka-iiwa7-r800")
    result = result_of(
        model, as_if_identified(model, 2), drive="armature,load_friction", variance=1e-20
    )
    load = tuple(
        replace(p, estimate=0.1) if p.name.startswith("Fl") else p for p in result.parameters
    )
    exported = export_result(replace(result, parameters=load), toml=tmp_path / "robot.toml")
    assert "load-dependent friction" in exported.notes["toml"][0]
    assert not export_result(result, toml=tmp_path / "robot.toml").notes


def test_unknown_terms_and_symbols_of_a_robot_file_are_refused(tmp_path: Path) -> None:
    text = format_robot_toml(
        replace(
            bundled_robot("two-link"),
            joints=tuple(
                replace(j, drive=DriveValues(terms={"stribeck": {"Fs": 1.0}}))
                for j in bundled_robot("two-link").joints
            ),
        )
    )
    for wrong, message in (
        ("stribek", "which does not exist"),
        ("Fx", "which has Fs, velocity, power"),
    ):
        path = tmp_path / f"{wrong}.toml"
        path.write_text(text.replace("stribeck" if wrong == "stribek" else "Fs", wrong))
        with pytest.raises(DescriptionError, match=message):
            described_drive(load_robot(path))


def test_values_with_other_shapes_are_not_taken_for_the_same() -> None:
    model = bundled_robot("two-link")
    stated = replace(
        model,
        joints=tuple(
            replace(j, drive=DriveValues(terms={"stribeck": {"Fs": 1.0, "velocity": 0.2}}))
            for j in model.joints
        ),
    )
    result = result_of(
        model, as_if_identified(model, 1, drives=False), drive="stribeck:velocity=0.2"
    )
    assert parameter_names(model, result.base.drive)[-1] == "Fs2"
    assert derive_cad_values(result, stated)[-1] == 1.0
    other = replace(
        result, base=find_base_parameters(model, DriveSet.parse("stribeck:velocity=0.3"))
    )
    assert np.isnan(derive_cad_values(other, stated)[-1])


def test_commands_take_the_exported_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The default engine says that it does not know these terms; the other one records them."""
    robot = export_result(rich_result("scara"), toml=tmp_path / "robot.toml").files["toml"]
    status, _, err = call(capsys, "simulate", robot, "--duration", 1, "--out", tmp_path / "log.csv")
    assert status == 2
    assert "--engine inverse-dynamics" in err
    assert (
        call(
            capsys,
            "simulate",
            robot,
            "--engine",
            "inverse-dynamics",
            "--duration",
            1,
            "--out",
            tmp_path / "log.csv",
        )[0]
        == 0
    )


def test_further_terms_that_push_are_refused() -> None:
    pushing = DriveValues(terms={"load_friction": {"Fl": -0.1}})
    model = bundled_robot("two-link")
    with pytest.raises(InertiaError, match=r"joint 1: load_friction Fl is -0\.1"):
        export_mjcf(
            replace(model, joints=(replace(model.joints[0], drive=pushing), model.joints[1]))
        )


def test_show_lists_further_terms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = export_result(rich_result("kuka-iiwa7-r800"), toml=tmp_path / "robot.toml").files[
        "toml"
    ]
    status, out, _ = call(capsys, "show", robot, "--full")
    assert status == 0
    assert "further drive terms" in out
    assert "spring Ks" in out
    assert "velocity 0.02" in out


@pytest.mark.parametrize("name", ["kuka-iiwa7-r800", "scara"])
def test_friction_of_the_description_is_not_counted_beside_what_was_identified_in_its_place(
    name: str, tmp_path: Path
) -> None:
    """A simulator's damping and friction, and terms that stand for them.

    MuJoCo, reading either file, has the identified friction alone.
    """
    import mujoco

    model = bundled_robot(name)
    model = replace(
        model,
        joints=tuple(
            replace(joint, drive=DriveValues(viscous=10.0, coulomb=5.0)) for joint in model.joints
        ),
    )
    result = result_of(
        model,
        as_if_identified(model, 2, drives=False),
        drive="asymmetric_coulomb,viscous:joints=2,power:exponent=0.7:joints=1",
        variance=1e-20,
    )
    names = parameter_names(model, result.base.drive)
    rng = np.random.default_rng(4)
    chi = np.concatenate(
        [
            as_if_identified(model, 2, drives=False).parameters,
            rng.uniform(0.2, 1.0, len(names) - 10 * model.n_joints),
        ]
    )
    values = result.base.values(chi)
    result = replace(
        result,
        parameters=tuple(
            replace(p, estimate=float(v)) for p, v in zip(result.parameters, values, strict=True)
        ),
    )
    exported = export_result(result, mjcf=tmp_path / "robot.xml", urdf=tmp_path / "robot.urdf")
    forwards, backwards = (
        np.array([chi[names.index(f"{symbol}{k + 1}")] for k in range(model.n_joints)])
        for symbol in ("Fcp", "Fcn")
    )
    damping = np.full(model.n_joints, 10.0)  # the description's, where nothing was identified
    damping[1] = chi[names.index("Fv2")]
    for kind in ("mjcf", "urdf"):
        compiled = mujoco.MjModel.from_xml_string(exported.files[kind].read_text())
        # At the first joint damping and friction that are nearest to `power` stand for it.
        np.testing.assert_allclose(
            compiled.dof_frictionloss[1:], 0.5 * (forwards + backwards)[1:], rtol=1e-12
        )
        np.testing.assert_allclose(np.ravel(compiled.dof_damping)[1:], damping[1:], rtol=1e-12)
        said = " ".join(exported.notes[kind])
        assert (
            f"viscous of the description is left out at {model.joint_names[0]}: power was"
            " identified in its place" in said
        )
        assert (
            "coulomb of the description is left out: asymmetric_coulomb was identified in its place"
            in said
        )
        assert "as described: viscous" in said
    assert f"{model.joint_names[0]} {0.5 * (forwards - backwards)[0]:.6g}" in " ".join(
        exported.notes["urdf"]
    )
