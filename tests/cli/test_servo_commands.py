"""From a log of commands to a simulator, on the command line."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import polars
import pytest
import yaml
from PIL import Image

from asbuilt.description import load_robot
from asbuilt.experiment import SignalChain, prepare_samples, read_recording
from asbuilt.identification import as_built_parameters
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.simulated_robot import (
    build_robot_as_built,
    choose_driving_signal,
)
from asbuilt.identification.trajectories.windows import cut_windows
from asbuilt.workflow import read_result
from asbuilt.writers import SIMULATOR_FORMATS
from command_line import call, document

WINDOWS = ("--rollout", "0.5,1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("servo")


@pytest.fixture
def study(folder: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """Return the log of a virtual servo arm beside its study, made once."""
    log = folder / "log.csv"
    if not log.exists():
        document(capsys, "simulate", "so-101", "--preset", "servo", "--duration", "12", "-o", log)
        document(capsys, "identify", "so-101", log, "--holdout", "last:0.3", "-o", folder / "study")
    return log


@pytest.mark.study
def test_a_rollout_proves_the_servo_arm(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result, picture, page = folder / "study" / "result.json", folder / "x.webp", folder / "pages"
    found = document(
        capsys, "validate", result, study, *WINDOWS, "--animation", picture, "-o", page
    )
    for rollout in found["rollout"]:
        assert rollout["driven_by"] == "command"
        assert rollout["as_built"]["rms_all"] < 0.3 * rollout["cad"]["rms_all"]
        assert rollout["as_built"]["rms_all"] < rollout["no_physics"]["rms_all"]
    text = Path(found["files"]["rollout"]).read_text()
    assert "data:image/webp;base64," in text
    assert text.count("<svg viewBox") == 5
    assert all(name in text for name in load_robot("so-101").joint_names)
    with Image.open(found["files"]["animation"]) as animation:
        assert animation.n_frames > 30
        frames = []
        for k in (0, animation.n_frames - 1):
            animation.seek(k)
            frames.append(np.asarray(animation.convert("RGB"), dtype=float))
    assert np.abs(frames[1] - frames[0]).max() > 100
    assert picture.stat().st_size < 2_000_000


@pytest.mark.study
def test_a_described_robot_has_a_page_too(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = document(capsys, "validate", "so-101", study, *WINDOWS, "-o", folder / "described")
    assert found["rollout"][0]["as_built"] is None
    assert "by CAD" in Path(found["files"]["rollout"]).read_text()


@pytest.mark.study
def test_an_animation_needs_a_rollout(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = folder / "study" / "result.json"
    status, _, err = call(capsys, "validate", result, study, "--animation", folder / "no.webp")
    assert status == 2
    assert "--animation" in err


@pytest.mark.study
def test_arms_of_a_humanoid_roll_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Fourteen joints on one torso, whose stiffness is stated by the sheet of the log."""
    log = tmp_path / "log.csv"
    document(capsys, "simulate", "g1-arms", "--preset", "servo", "--duration", "14", "-o", log)
    found = document(capsys, "identify", "g1-arms", log, "--holdout", "last:0.3", *WINDOWS)
    truth = load_robot(str(log.with_name("log_robot.toml")))
    assert len(found["joints"]) == truth.n_joints == 14
    for rollout in found["rollout"]:
        assert rollout["n_windows"] >= 4
        assert rollout["as_built"]["rms_all"] < 0.5 * rollout["cad"]["rms_all"]
    (delay,) = found["delay"]
    assert abs(delay["estimate"] - 0.01) < 0.001


@pytest.mark.parametrize(("ending", "option"), [(".xml", ()), (".urdf", ("--urdf",))])
def test_an_ensemble_is_a_folder_that_its_module_loads(
    ending: str,
    option: tuple[str, ...],
    study: Path,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    place = folder / f"ensemble{ending}"
    told = ("export", folder / "study" / "result.json", *option, "--ensemble", 4, "-o", place)
    found = document(capsys, *told, "--seed", 1)
    frame = polars.read_parquet(place / "parameters.parquet")
    assert frame.height == found["draws"] == 4
    ranges = {each["name"]: (each["q05"], each["q95"]) for each in found["parameters"]}
    for name, (low, high) in ranges.items():
        assert low <= high, name
        assert np.allclose((low, high), np.quantile(frame[name], [0.05, 0.95])), name
    assert ranges["Ia1"][0] < ranges["Ia1"][1]
    for k, path in enumerate(found["files"]["models"]):
        assert path.endswith(ending)
        again = load_robot(path)
        row = frame.row(k, named=True)
        masses = [link.inertia.mass for link in again.links]
        assert np.allclose(masses, [row[f"m{i + 1}"] for i in range(5)], rtol=1e-9)
        if ending == ".xml":
            own = [joint.drive.armature for joint in again.joints]
            assert np.allclose(own, [row[f"Ia{i + 1}"] for i in range(5)], rtol=1e-9)
    run = subprocess.run(
        [sys.executable, place / "load_ensemble.py"], capture_output=True, text=True, check=True
    )
    totals = [float(line.split()[-1]) for line in run.stdout.splitlines()]
    held = [float(frame.row(k, named=True)["m1"]) for k in range(4)]
    assert len(totals) == 4
    assert all(total > mass for total, mass in zip(totals, held, strict=True))
    before = frame.to_numpy()
    document(capsys, *told, "--seed", 1)
    assert np.array_equal(polars.read_parquet(place / "parameters.parquet").to_numpy(), before)


@pytest.mark.study
def test_every_simulator_format_is_written_and_says_what_it_cannot_hold(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    endings = {"usd": ".usda", "bam": ".json", "isaac-lab": ".py", "mjlab": ".py"}
    places = {key: folder / f"{key}{endings.get(key, '.xml')}" for key in SIMULATOR_FORMATS}
    told = [x for key, place in places.items() for x in ("--to", f"{key}={place}")]
    found = document(capsys, "export", folder / "study" / "result.json", *told)
    assert {Path(found["files"][key]) for key in places} == set(places.values())
    assert all(found["notes"][key] for key in places), "this result has an offset and a delay"
    result = read_result(folder / "study" / "result.json")
    armature = as_built_parameters(result).parameters[50 :: result.base.drive.columns_per_joint]
    bam = json.loads(places["bam"].read_text())
    assert np.allclose([bam[name]["armature"] for name in result.joint_names], armature)
    for key in ("isaac-lab", "mjlab"):
        text = places[key].read_text()
        compile(text, key, "exec")
        assert all(f"{value!r}" in text for value in armature.tolist()), key
    gains = yaml.safe_load(places["ros2-control"].read_text())["pid_controller"]
    assert gains["ros__parameters"]["dof_names"] == list(result.joint_names)
    usd = places["usd"].read_text()
    stiffness = [float(x) for x in re.findall(r"physics:stiffness = (\S+)", usd)]
    assert result.servo is not None
    assert np.allclose(np.array(stiffness) * np.degrees(1.0), result.servo.kp)


def test_the_exported_mjcf_moves_as_the_rollout(
    study: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """MuJoCo's own actuators, stepped one by one, against asbuilt's rollout of the result."""
    place = folder / "as_built.xml"
    document(capsys, "export", folder / "study" / "result.json", "--mjcf", place)
    result = read_result(folder / "study" / "result.json")
    assert result.servo is not None
    recording = read_recording(study, model=result.model)
    samples = prepare_samples(recording, SignalChain(cutoff=10.0, rests=True))
    windows = cut_windows(recording, samples, 0.5, choose_driving_signal(recording)).some(
        slice(0, 6)
    )
    own = simulate_windows(build_robot_as_built(result, result.servo), windows)
    robot = mujoco.MjModel.from_xml_path(str(place))
    assert robot.opt.timestep == windows.step
    for w, controls in enumerate(windows.inputs(result.servo.delay or 0.0)):
        data = mujoco.MjData(robot)
        data.qpos[:], data.qvel[:] = windows.start_q[w], windows.start_qd[w]
        q = [data.qpos.copy()]
        for control in controls:
            data.ctrl[:] = control
            mujoco.mj_step(robot, data)
            q.append(data.qpos.copy())
        np.testing.assert_allclose(np.array(q[:: windows.divisions]), own[w], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("columns", "gains", "worst"),
    [("20-25", [14.87, 13.26, 11.13, 10.62, 11.03, 11.47], 8e-3), ("26-31", None, 6e-4)],
)
@pytest.mark.study
def test_commanded_currents_and_torques_of_a_ur10e_roll_out(
    columns: str,
    gains: list[float] | None,
    worst: float,
    shared: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`i_desired` with the gains of its publication, and `tau_desired`, of a real arm."""
    sheet = tmp_path / "ur10e.toml"
    sheet.write_text(
        'torque_source = "command"\n'
        + (f"gains = {gains}\n" if gains else "")
        + '[columns]\ntime = 1\nposition = "2-7"\nvelocity = "8-13"\n'
        + f'torque = "{columns}"\n'
    )
    first, other = (
        shared / "data" / "ur10e" / name
        for name in ("ur-20_02_10-30sec_12harm.csv", "ur-20_02_12-40sec_12harm.csv")
    )
    told = ("identify", "ur10e", first, "--sheet", sheet, "--validate", other)
    found = document(capsys, *told, "--rollout", "0.1,0.5")
    assert found["validation"][0]["relative_error"] < 0.03
    for rollout, most in zip(found["rollout"], (worst / 8.0, worst), strict=True):
        assert rollout["driven_by"] == "torque"
        assert rollout["no_physics"] is None
        assert rollout["as_built"]["rms_all"] < most
        assert rollout["cad"]["diverged"] > rollout["as_built"]["diverged"] == 0
        assert rollout["cad"]["rms_all_until"] > 10.0 * rollout["as_built"]["rms_all_until"]
