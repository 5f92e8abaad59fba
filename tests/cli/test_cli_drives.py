"""Drive terms, gains and two channels on the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import LinkInertia, bundled_robot, load_robot
from asbuilt.dynamics import DriveSet, available_terms, drive_torque, inverse_dynamics
from asbuilt.excitation import random_fourier
from asbuilt.experiment import read_recordings
from asbuilt.writers.models.robot_toml import format_robot_toml
from command_line import call, document

DRIVE = DriveSet.parse("viscous,coulomb,load_friction,offset")


def log(path: Path, robot: str, torque, *, seed: int = 2) -> Path:
    """Write a recording of a robot along a random motion.

    `torque(model, q, qd, qdd)` is what it logs.
    """
    model = bundled_robot(robot)
    motion = random_fourier(model, seed, duration=16.0).sample(100.0)
    tau = torque(model, motion.q, motion.qd, motion.qdd) + 0.02 * np.random.default_rng(
        seed
    ).normal(size=motion.q.shape)
    n = model.n_joints
    header = ",".join(["t", *(f"q_{k}" for k in range(n)), *(f"tau_{k}" for k in range(n))])
    np.savetxt(
        path, np.column_stack([motion.t, motion.q, tau]), delimiter=",", header=header, comments=""
    )
    return path


def driven(values, drive=DRIVE, scale=1.0):
    def torque(model, *state):
        rigid = inverse_dynamics(model, *state)
        return scale * (
            rigid + drive_torque(drive, np.tile(values, model.n_joints), *state, load=rigid)
        )

    return torque


def test_drives_are_listed(capsys):
    listed = document(capsys, "drives")["drives"]
    assert [each["key"] for each in listed] == list(available_terms())
    assert all(each["formula"] and len(each["parameters"]) == len(each["units"]) for each in listed)
    status, out, _ = call(capsys, "drives")
    assert status == 0
    assert "stribeck" in out
    assert "auto" in out


@pytest.mark.study
@pytest.mark.parametrize("robot", ["scara"])
def test_terms_are_chosen_or_given_for_any_robot(capsys, tmp_path, robot):
    recording = log(tmp_path / "log.csv", robot, driven([0.5, 1.0, 0.15, 0.1]))
    chosen = document(
        capsys,
        "identify",
        robot,
        recording,
        "--torque-source",
        "sensor",
        "--drive",
        "auto",
        "--holdout",
        "blocks:2s:4",
    )
    assert "load_friction" in chosen["drive"]
    named = {(each["effect"], each["in_model"]) for each in chosen["effects"]}
    assert ("load_friction", True) in named
    given = document(
        capsys,
        "identify",
        robot,
        recording,
        "--torque-source",
        "sensor",
        "--drive",
        "viscous,coulomb,stribeck,load_friction,offset",
    )
    assert "stribeck:velocity=" in given["drive"]
    assert any(note.startswith("Chosen automatically") for note in given["notes"])


@pytest.mark.parametrize(
    ("drive", "said"),
    [
        ("stribek", "did you mean 'stribeck'"),
        ("stribeck:velocity=fast", "name=number"),
        ("smooth_coulomb:width=0.1/0.2", "one per joint"),
        ("spring:joints=12", "names joint 12"),
        ("auto,sprang", "did you mean 'spring'"),
    ],
)
def test_wrong_terms_say_what_is_right(capsys, tmp_path, drive, said):
    recording = log(tmp_path / "log.csv", "scara", driven([0.5, 1.0, 0.15, 0.1]))
    status, _, err = call(capsys, "identify", "scara", recording, "--drive", drive)
    assert status == 2
    assert said in err


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A UR10e without and with 4 kg that logs amperes, 10 N m each."""
    folder = tmp_path_factory.mktemp("pair")
    plain = DriveSet.parse("viscous,coulomb,offset")
    chi = bundled_robot("ur10e").parameters.copy()
    chi[-10:] += LinkInertia.from_com(4.0, [0.06, 0.03, 0.05], 0.01 * np.eye(3)).parameters

    def loaded(model, *state):
        return driven([0.5, 1.0, 0.1], plain, 0.1)(model.with_parameters(chi), *state)

    bare = log(folder / "bare.csv", "ur10e", driven([0.5, 1.0, 0.1], plain, 0.1))
    return bare, log(folder / "loaded.csv", "ur10e", loaded, seed=3)


def weighing(pair: tuple[Path, Path]) -> tuple[object, ...]:
    return (
        "gains",
        "ur10e",
        pair[0],
        "--loaded",
        pair[1],
        "--mass",
        "4",
        "--frame",
        bundled_robot("ur10e").link_names[-1],
    )


@pytest.mark.parametrize(
    ("sheet", "gain", "flip", "sign"),
    [
        pytest.param(None, None, False, 1, marks=pytest.mark.study),
        pytest.param("gains = 20", "7,8,9,10,11,12", False, 1, marks=pytest.mark.study),
        pytest.param(
            "sign = [-1, 1, 1, 1, 1, 1]\ngains = 8",
            None,
            False,
            [-1, 1, 1, 1, 1, 1],
            marks=pytest.mark.study,
        ),
        ("sign = -1\ngains = 8", "-3", True, 1),
    ],
)
def test_gains_pasted_into_the_next_command_are_right(
    capsys, tmp_path, pair, sheet, gain, flip, sign
):
    described = [] if sheet is None else ["--sheet", tmp_path / "sheet.toml"]
    (tmp_path / "sheet.toml").write_text(sheet or "")
    turned = ["--flip-torque"] if flip else []
    found = document(
        capsys, *weighing(pair), *described, *turned, *([] if gain is None else [f"--gain={gain}"])
    )
    np.testing.assert_allclose(np.array(found["gains"]) * sign, 10.0, rtol=0.05)
    np.testing.assert_allclose(np.array(found["in_use"]) * found["factors"], found["gains"])

    pasted = document(capsys, *weighing(pair), *described, *turned, found["option"])
    assert np.all(
        np.abs(np.array(pasted["factors"]) - 1.0) < 0.05 * np.array(pasted["factor_std_errors"])
    )
    (tmp_path / "corrected.toml").write_text(
        "\n".join(
            [*(line for line in (sheet or "").split("\n") if "gains" not in line), found["sheet"]]
        )
    )
    written = document(capsys, *weighing(pair), "--sheet", tmp_path / "corrected.toml", *turned)
    np.testing.assert_allclose(written["factors"], pasted["factors"])

    torque, amperes = (
        read_recordings(
            [pair[0]],
            model=bundled_robot("ur10e"),
            sheet=tmp_path / "sheet.toml" if options else None,
            flip_torque=bool(options) and flip,
            **options,
        )[0].tau
        for options in ({"gain": found["gain"]}, {})
    )
    np.testing.assert_allclose(torque, 10.0 * amperes, rtol=0.05)


def test_gains_are_printed_as_option_and_sheet_line(capsys, pair):
    status, out, _ = call(capsys, *weighing(pair), "--gain", "5")
    assert status == 0
    assert "\n  --gain=" in out
    assert "\n  gains = [" in out
    assert call(capsys, *weighing(pair), "--com", "1,2")[0] == 2


def test_recordings_scaled_by_different_gains_are_refused(capsys, tmp_path, pair):
    (pair[0].parent / "loaded.toml").write_text("gains = 3")
    try:
        status, _, err = call(capsys, *weighing(pair))
    finally:
        (pair[0].parent / "loaded.toml").unlink()
    assert status == 2
    assert "same gains" in err


@pytest.fixture(scope="module", params=["puma-560"])
def coupled(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, int]:
    """A robot file whose last motor turns with the joint before it too, and has friction and
    inertia of its own.
    """
    model = bundled_robot(request.param)
    n = model.n_joints
    terms = {
        "motor_armature": {"Iam": 0.4},
        "motor_viscous": {"Fvm": 3.0},
        "motor_coulomb": {"Fcm": 2.0},
    }
    joints = (
        *model.joints[:-1],
        replace(model.joints[-1], drive=replace(model.joints[-1].drive, terms=terms)),
    )
    coupling = np.eye(n)
    coupling[n - 1, n - 2] = 1.0
    path = tmp_path_factory.mktemp("coupled") / "robot.toml"
    path.write_text(format_robot_toml(replace(model, joints=joints, motor_coupling=coupling)))
    return path, n


@pytest.mark.study
def test_a_coupled_wrist_from_file_to_result(capsys, tmp_path, coupled):
    robot, n = coupled
    lab = tmp_path / "log.csv"
    simulated = (
        "--engine",
        "inverse-dynamics",
        "--preset",
        "lab",
        "--rate",
        "200",
        "--duration",
        "24",
        "--seed",
        "3",
    )
    document(capsys, "simulate", robot, *simulated, "--out", lab)
    judged = ("--holdout", "blocks:2s:4", "--method", "wls")
    found = document(capsys, "identify", robot, lab, "--torque-source", "motor", *judged)
    assert f"motor_viscous:joints={n}" in found["drive"]
    values = {parameter["name"]: parameter["estimate"] for parameter in found["parameters"]}
    assert values[f"Fvm{n}"] == pytest.approx(3.0, rel=0.1)
    assert values[f"Fcm{n}"] == pytest.approx(2.0, rel=0.1)
    alone = document(
        capsys,
        "identify",
        robot,
        lab,
        "--torque-source",
        "motor",
        *judged,
        "--drive",
        "armature,viscous,coulomb,offset",
    )
    assert all(
        found["validation"][0]["rms"][k] < 0.5 * alone["validation"][0]["rms"][k]
        for k in (n - 2, n - 1)
    )
    sensed = document(capsys, "identify", robot, lab, "--torque-source", "sensor", *judged)
    assert not any("motor_" in term for term in sensed["drive"])


@pytest.mark.study
def test_both_sides_of_a_coupled_wrist(capsys, tmp_path, coupled):
    robot, n = coupled
    model = load_robot(str(robot))
    ahead = DriveSet.parse(f"armature,viscous,coulomb,motor_viscous:joints={n},offset")

    def sensor(_, *state):
        return inverse_dynamics(model, *state)

    def motor(_, *state):
        values = np.tile([0.5, 1.0, 3.0, 2.0, 0.4], n)
        return inverse_dynamics(model, *state) + drive_torque(
            ahead, values, *state, shares=model.motor_shares
        )

    logs = [
        log(tmp_path / f"{name}.csv", model.name, torque)
        for name, torque in (("sensor", sensor), ("motor", motor))
    ]
    found = document(capsys, "channels", robot, logs[0], "--motor", logs[1])
    values = {
        parameter["name"]: parameter["estimate"]
        for parameter in found["parameters"]
        if parameter["side"] == "motor"
    }
    assert values[f"Fvmm{n}"] == pytest.approx(3.0, abs=0.05)
    assert values[f"Fvm{n - 1}"] == pytest.approx(1.0, abs=0.05)
    assert values[f"Iamm{n}"] == pytest.approx(0.0, abs=0.05)
    assert f"Fvmm{n - 1}" not in values
    plain = ("--motor-drive", "armature,viscous,coulomb,offset", "--drive", "none")
    fewer = document(capsys, "channels", robot, logs[0], "--motor", logs[1], *plain)
    assert fewer["rms_motor"][n - 1] > 10.0 * found["rms_motor"][n - 1]
    status, out, err = call(capsys, "channels", robot, logs[0], "--motor", logs[1], "--full")
    assert status == 0, err
    assert "names with m" in " ".join(out.split())


def test_sensor_and_motor_together(capsys, tmp_path):
    behind = DriveSet.parse("viscous,coulomb,offset")
    ahead = DriveSet.parse("armature,viscous,coulomb,offset")
    sensor = log(tmp_path / "sensor.csv", "scara", driven([0.2, 0.3, 0.1], behind))

    def motor(model, *state):
        return driven([0.2, 0.3, 0.1], behind)(model, *state) + drive_torque(
            ahead, np.tile([0.5, 1.0, 2.0, 0.4], model.n_joints), *state
        )

    found = document(
        capsys, "channels", "scara", sensor, "--motor", log(tmp_path / "motor.csv", "scara", motor)
    )
    values = {parameter["name"]: parameter["estimate"] for parameter in found["parameters"]}
    assert values["Iam1"] == pytest.approx(0.5, abs=0.05)
    assert values["Fvm2"] == pytest.approx(1.0, abs=0.1)
    assert call(capsys, "channels", "scara", sensor, "--motor", tmp_path / "nothing.csv")[0] == 1
