import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reload_oracle import as_if_identified, mujoco_torques, pinocchio_torques

from asbuilt.description import DriveValues, RobotModel, bundled_robot, load_robot
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix, parameter_values
from asbuilt.errors import DescriptionError, InertiaError, UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot, read_recordings
from asbuilt.identification import IdentificationResult, IdentifiedParameter, torque_metrics
from asbuilt.workflow import StudyOptions, identify
from asbuilt.writers import export_result, write_recording
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.urdf import format_urdf
from command_line import call
from studied_cases import first_of

ALL = "armature,viscous,coulomb,offset"


def result_of(
    model: RobotModel, truth: RobotModel, drive: str = ALL, *, variance: float = 1e-4
) -> IdentificationResult:
    """Return the result of an identification that found exactly the torques of `truth`."""
    base = find_base_parameters(model, DriveSet.parse(drive))
    p, n = base.n_base, model.n_joints
    known = parameter_values(truth, base.drive)
    beta, cad = base.values(np.nan_to_num(known)), base.values(parameter_values(model, base.drive))
    entries = zip(
        base.ids, base.names, base.expressions, base.symbolic, base.units, cad, beta, strict=True
    )
    parameters = tuple(
        IdentifiedParameter(
            int(i),
            name,
            e,
            s,
            u,
            float(c),
            float(b),
            0.01,
            0.01,
            determined=True,
            poorly_determined=False,
        )
        for i, name, e, s, u, c, b in entries
    )
    metrics = torque_metrics(np.ones((5, n)), np.ones((5, n)), "log.csv", model.joint_names)
    return IdentificationResult(
        model=model, base=base, method="wls", sources=("log.csv",), n_samples=5, rate=100.0,
        duration=1.0, parameters=parameters, covariance=variance * np.eye(p),
        textbook_covariance=variance * np.eye(p), sigma=np.ones(n), effective_samples=5.0, rank=p,
        singular_values=np.ones(p), condition_number=1.0, scaled_condition_number=1.0,
        undetermined=(), train=metrics, validation=(), cad=metrics, physically_consistent=True,
        consistency_margin=0.1, findings=(), provenance=(),
    )  # fmt: skip


@pytest.mark.parametrize(
    "name",
    first_of(2, ["lbrstack_med7.urdf", "kuka_lwr4.urdf", "kuka-iiwa7-r800", "ur10e", "scara"]),
)
def test_every_export_gives_the_identified_torques(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    robot = request.getfixturevalue("shared") / "models" / name if name.endswith(".urdf") else name
    model = load_robot(str(robot))
    result = result_of(model, as_if_identified(model, 2), variance=1e-20)
    places = {kind: tmp_path / f"robot.{kind}" for kind in ("urdf", "mjcf", "toml", "c")}
    exported = export_result(result, **places)
    assert set(exported.files) == {*places, "header"}
    q, qd, qdd = draw_sample_states(model, 20)
    qd = np.where(np.abs(qd) < 0.1, 0.1, qd)
    expected = (
        observation_matrix(model, q, qd, qdd, drive=result.base.drive, columns=result.base.columns)
        @ result.estimates
    ).reshape(q.shape)
    written = load_robot(places["toml"])
    values = parameter_values(written, result.base.drive)[10 * model.n_joints :].reshape(
        model.n_joints, 4
    )
    armature, viscous, coulomb, offset = values.T
    in_mujoco = (
        mujoco_torques(places["mjcf"].read_text(encoding="utf-8"), model.joint_names, q, qd, qdd)
        + offset
    )
    in_pinocchio = pinocchio_torques(
        places["urdf"].read_bytes().partition(b"?>")[2].decode(),
        model.joint_names,
        model.gravity,
        q,
        qd,
        qdd,
    )
    drives = armature * qdd + viscous * qd + coulomb * np.sign(qd) + offset
    own = (
        observation_matrix(written, q, qd, qdd, drive=result.base.drive)
        @ parameter_values(written, result.base.drive)
    ).reshape(q.shape)
    for found in (in_mujoco, in_pinocchio + drives, own):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    described = load_robot(places["urdf"])
    np.testing.assert_allclose(
        [joint.drive.viscous for joint in described.joints], viscous, rtol=1e-15
    )
    program = tmp_path / "self_test"
    prefix = places["c"].read_text().split("_inverse_dynamics")[0].split()[-1].upper()
    subprocess.run(
        [
            "gcc",
            "-std=c99",
            f"-D{prefix}_SELF_TEST",
            str(places["c"]),
            "-o",
            str(program),
            "-lm",
            "-Werror",
            "-Wall",
        ],
        check=True,
    )
    subprocess.run([str(program)], check=True, capture_output=True)


def arm_urdf(folder: Path) -> Path:
    """Write a URDF of two-link with a comment in it."""
    path = folder / "arm.urdf"
    path.write_text(
        format_urdf(bundled_robot("two-link")).replace(
            "</robot>", "<!-- the user's own -->\n</robot>"
        )
    )
    return path


def test_command_writes_what_was_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    original = arm_urdf(tmp_path)
    model = load_robot(original)
    stored = tmp_path / "result.json"
    stored.write_text(result_of(model, as_if_identified(model, 2)).to_json())
    places = {kind: tmp_path / "out" / f"robot.{kind}" for kind in ("urdf", "mjcf", "toml", "c")}
    options = [part for kind, place in places.items() for part in (f"--{kind}", place)]
    status, out, _ = call(capsys, "export", stored, *options, "--json")
    document = json.loads(out)
    assert status == 0
    assert document["robot"] == model.name
    assert document["files"] == {kind: str(place) for kind, place in places.items()} | {
        "header": str(tmp_path / "out" / "robot.h")
    }
    assert {"armature", "offset"} == {
        word
        for word in ("armature", "offset", "shapes")
        if any(word in note for note in document["notes"]["urdf"])
    }
    assert "the user's own" in places["urdf"].read_text()
    status, out, _ = call(capsys, "export", stored, "--urdf", places["urdf"])
    assert status == 0
    assert "closest to CAD" in out
    assert "note: URDF has no place for the armature" in out


def test_command_refuses_without_writing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = bundled_robot("two-link")
    result = result_of(model, as_if_identified(model, 2))
    negative = tuple(
        replace(p, estimate=-5.0) if p.name == "Izz2" else p for p in result.parameters
    )
    stored = tmp_path / "result.json"
    stored.write_text(replace(result, parameters=negative).to_json())
    target = tmp_path / "robot.xml"
    status, out, err = call(capsys, "export", stored, "--mjcf", target, "--json")
    error = json.loads(out)["error"]
    assert (status, err, error["kind"]) == (1, "", "InertiaError")
    assert "Izz2 + 0.796 mx2" in error["message"]
    assert "standard errors below zero" in error["message"]
    assert "kg;" not in error["message"]
    assert "--nearest" in error["hint"]
    assert not target.exists()
    status, _, err = call(capsys, "export", stored, "--mjcf", target, "--nearest")
    assert status == 1
    assert "times the identified model's" in err
    assert "--method consistent" in err
    assert "--mounting estimate" in err
    assert not target.exists()
    assert call(capsys, "export", stored, "--mjcf", target, "--nearest", "--force")[0] == 0
    assert load_robot(target).n_joints == 2
    status, _, err = call(capsys, "export", stored)
    assert status == 2
    assert "--urdf FILE, --mjcf FILE, --toml FILE, --c FILE" in err
    assert (
        call(capsys, "export", stored, "--c", tmp_path / "robot.cpp", "--nearest", "--force")[0]
        == 2
    )
    assert call(capsys, "export", stored, "--mjcf", target, "--original", target)[0] == 2
    assert call(capsys, "export", stored, "--mjcf", target, "--force")[0] == 2
    assert call(capsys, "export", tmp_path / "nowhere.json", "--mjcf", target)[0] in (1, 2)


def test_non_passive_friction_is_refused() -> None:
    model = bundled_robot("two-link")
    result = result_of(model, as_if_identified(model, 2))
    negative = tuple(replace(p, estimate=-0.3) if p.name == "Fv1" else p for p in result.parameters)
    with pytest.raises(InertiaError, match=r"Fv1 is -0\.300 \+/- 0\.010 \(base"):
        export_result(replace(result, parameters=negative), mjcf="nowhere.xml")
    assert not Path("nowhere.xml").exists()


def test_where_the_urdf_to_edit_comes_from(tmp_path: Path) -> None:
    original = arm_urdf(tmp_path)
    model = load_robot(original)
    result = result_of(model, as_if_identified(model, 2))
    moved = original.rename(tmp_path / "moved.urdf")
    fresh = export_result(result, urdf=tmp_path / "fresh.urdf")
    assert "does not exist" in fresh.notes["urdf"][0]
    assert "the user's own" not in (tmp_path / "fresh.urdf").read_text()
    edited = export_result(result, urdf=tmp_path / "edited.urdf", original=moved)
    assert "the user's own" in edited.files["urdf"].read_text()
    moved.write_text("<mujoco/>")
    with pytest.raises(DescriptionError, match="is no URDF"):
        export_result(result, urdf=tmp_path / "x.urdf", original=moved)
    with pytest.raises(UsageError, match="no file to export"):
        export_result(result)


def test_drive_terms_without_a_place_are_said(tmp_path: Path) -> None:
    model = bundled_robot("two-link")
    result = result_of(model, as_if_identified(model, 2), drive="viscous,cubic")
    places: dict[str, Any] = {
        kind: tmp_path / f"robot.{kind}" for kind in ("urdf", "mjcf", "toml", "c")
    }
    exported = export_result(result, **places)
    for kind in ("urdf", "mjcf"):
        assert "no place for the drive terms cubic" in exported.notes[kind][-1]
    assert not {"c", "toml"} & set(exported.notes)


def test_drive_values_that_were_not_identified_are_said(tmp_path: Path) -> None:
    model = bundled_robot("two-link")
    described = replace(
        model,
        joints=tuple(
            replace(joint, drive=DriveValues(viscous=10.0, coulomb=0.0)) for joint in model.joints
        ),
    )
    exported = export_result(
        result_of(described, as_if_identified(model, 2), drive="coulomb"),
        mjcf=tmp_path / "robot.xml",
    )
    assert exported.notes["mjcf"] == ("not identified, and as described: viscous of the drives",)
    assert [joint.drive.viscous for joint in load_robot(tmp_path / "robot.xml").joints] == [
        10.0,
        10.0,
    ]


@pytest.mark.study
def test_a_study_leaves_the_edited_urdf_behind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    original = arm_urdf(tmp_path)
    model = load_robot(original)
    recording = (
        VirtualRobot.ideal(model)
        .record(random_fourier(model, rng=1, duration=8.0), rate=200.0, rng=1)
        .recording
    )
    columns = {"t": recording.t} | {
        f"{what}_{k}": getattr(recording, what)[:, k] for what in ("q", "tau") for k in range(2)
    }
    log = tmp_path / "log.csv"
    np.savetxt(
        log,
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    status, out, err = call(
        capsys,
        "identify",
        original,
        log,
        "--method",
        "consistent",
        "--drive",
        "none",
        "--out",
        tmp_path / "out",
        "--json",
    )
    assert status == 0, err
    files = json.loads(out)["files"]
    assert "the user's own" in Path(files["urdf"]).read_text()
    assert load_robot(files["urdf"]).joint_names == model.joint_names


@pytest.mark.study
def test_the_nearest_robot_says_what_it_costs_on_the_recordings(
    shared: Path, tmp_path: Path
) -> None:
    """The nearest consistent model of the Med 7 predicts its held-out blocks as well.

    It does not predict random motion, where neither model was identified.
    """
    model = load_robot(shared / "models" / "lbrstack_med7.urdf")
    log = read_recordings(
        [shared / "data" / "lbr_med7" / "measurements_with_ext_tau_1_dgr.csv"],
        model=model,
        rate=100.0,
        flip_torque=True,
    )
    options = StudyOptions(holdout="blocks:5s:3", method="wls", checked=False)
    study = identify(model, log, options=options)
    with pytest.raises(InertiaError, match=r"standard errors below zero") as refused:
        export_result(study.result, toml=tmp_path / "robot.toml")
    assert "mass is" not in str(refused.value)
    exported = export_result(study.result, toml=tmp_path / "robot.toml", nearest=True)
    assert exported.cost is not None
    np.testing.assert_allclose(exported.cost.identified, study.result.validation[0].rms, rtol=1e-6)
    assert np.all(exported.cost.nearest < 1.4 * exported.cost.identified)
    assert "as written" in exported.as_text()
    assert "In random motion the torques of the two models differ" in exported.as_text()
    short = read_recordings(
        [shared / "data" / "kuka_lwr4" / "measurements_1.npz"],
        model=load_robot(shared / "models" / "kuka_lwr4.urdf"),
    )
    other = identify(
        load_robot(shared / "models" / "kuka_lwr4.urdf"),
        short,
        options=options,
    ).result
    with pytest.raises(InertiaError, match=r"lwr_6_joint: 0\.\d+ N m RMS in place of"):
        export_result(other, toml=tmp_path / "other.toml", nearest=True)
    assert not (tmp_path / "other.toml").exists()
    assert (
        export_result(other, toml=tmp_path / "other.toml", nearest=True, force=True).cost
        is not None
    )


@pytest.mark.study
def test_a_study_says_what_its_files_cannot_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The robot of an identification comes as URDF, too.

    What is left out of that is told where the file is named, and in the JSON.
    """
    original = arm_urdf(tmp_path)
    model = load_robot(original)
    log = tmp_path / "log.csv"
    write_recording(
        log, VirtualRobot.ideal(model).record(random_fourier(model, rng=3), rate=100.0).recording
    )
    call_of = ("identify", original, log, "--drive", ALL, "--out", tmp_path / "out")
    status, out, _ = call(capsys, *call_of, "--full")
    assert status == 0
    listing = out[out.index("written:") :]
    assert "robot.urdf\n              note: URDF has no place for the armature" in listing
    document = json.loads(call(capsys, *call_of, "--json")[1])
    assert any("offset" in note for note in document["file_notes"]["urdf"])
    impossible = json.loads(
        call(capsys, *call_of, "--method", "wls", "--drive", "viscous,coulomb,offset", "--json")[1]
    )
    assert ("urdf" in impossible["files"]) == (
        not any("not written" in note for note in impossible["file_notes"].get("urdf", ()))
    )
