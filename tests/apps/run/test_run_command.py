"""`asbuilt run` by its command line: rounds, resuming, wrong logs, confirmation."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import asbuilt
from asbuilt import Recording, load_robot, random_fourier
from asbuilt.apps.run import DRIVERS, DriverRequest, RunOptions, open_driver
from asbuilt.apps.run.folder import RunFolder, RunSettings
from asbuilt.excitation import Motion
from command_line import call

QUICK = ("two-link", "--seconds", 6)


def lines(out: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.splitlines()]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """The folder and the JSON lines of a loop that proved its model."""
    folder = tmp_path_factory.mktemp("finished") / "loop"
    command = ("run", *map(str, QUICK), "--on", "virtual:lab", "-o", str(folder), "--json")
    done = subprocess.run(
        [sys.executable, "-m", "asbuilt", *command],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    return folder, lines(done.stdout)


@pytest.mark.study
def test_loop_proves_the_model_of_a_robot_unlike_its_description(
    finished: tuple[Path, list[dict[str, Any]]],
) -> None:
    folder, (*rounds, summary) = finished
    assert summary["ending"] == "proven"
    assert summary["verdict"]["use"] == "yes"
    assert [each["round"] for each in rounds] == [*range(1, len(rounds) + 1)]
    assert rounds[0]["promised"] is None
    assert rounds[0]["found"] > rounds[-1]["found"]
    for each in rounds[-2:]:
        assert each["verdict"] == "yes"
        assert max(each["found"], each["goal"]) <= 0.05
    assert all(Path(path).is_file() for path in summary["files"].values())
    assert asbuilt.read_study(folder / "result.json").verdict.use == "yes"


@pytest.mark.study
def test_first_round_is_slow_and_small_and_every_motion_keeps_the_limits(
    finished: tuple[Path, list[dict[str, Any]]],
) -> None:
    _folder, (*rounds, _) = finished
    model = asbuilt.load_robot("two-link")
    peaks = []
    for each in rounds:
        motion = asbuilt.read_motion(each["motion"], model)
        _, qd, _ = motion.at(motion.sample_times(500.0))
        assert asbuilt.excitation.check_motion(model, motion).is_respected
        peaks.append(np.abs(qd).max(axis=0))
    limit = np.array([joint.limits.velocity for joint in model.joints])
    assert np.all(peaks[0] <= 0.3 * limit * (1 + 1e-9))
    assert np.any(peaks[-1] > 0.3 * limit)


@pytest.mark.study
def test_promise_holds_on_motion_of_another_kind(
    finished: tuple[Path, list[dict[str, Any]]],
) -> None:
    """The robot itself is recorded again, on random motion that no round saw."""
    folder, (*_, summary) = finished
    model = asbuilt.load_robot("two-link")
    robot = DRIVERS.find("virtual")(DriverRequest(model=model, argument="lab"))
    log = robot.record(asbuilt.random_fourier(model, 77))
    (found,) = asbuilt.validate(asbuilt.read_result(folder / "result.json"), log)
    assert found.metrics_as_built.relative_error <= 1.5 * summary["promised"]


@pytest.mark.study
def test_resumed_loop_has_the_same_rounds(
    finished: tuple[Path, list[dict[str, Any]]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, (*rounds, _) = finished
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    for path in copy.glob(f"round_{len(rounds)}*"):
        path.unlink()
    status, out, err = call(capsys, "run", "two-link", "--resume", copy, "--json")
    assert status == 0, err
    assert [each["found"] for each in lines(out)[:-1]] == [each["found"] for each in rounds]


@pytest.mark.study
def test_screen_has_a_line_a_round_a_picture_and_a_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    status, out, _ = call(capsys, "run", *QUICK, "--on", "virtual:lab", "--rounds", 2)
    assert status == 1
    assert max(map(len, out.splitlines())) <= 80
    assert "    1        6         -" in out
    assert "promised (p) and found (f)" in out
    sentences = " ".join(out.split())
    assert "The error is within 5.0 %, but not with USE in 2 rounds in a row" in sentences
    assert "(2 rounds, 12 s of motion)" in sentences


def answer_by_hand(folder: Path, name: str, log: Recording) -> None:
    asbuilt.write_recording(folder / "inbox" / f"{name}.csv", log)
    (folder / "inbox" / f"{name}.toml").write_text('torque_source = "sensor"\n')


@pytest.mark.study
def test_files_go_out_and_logs_come_in_across_restarts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C ends the wait for a log; the loop that is resumed learns it and sends the next."""
    box, folder = tmp_path / "exchange", tmp_path / "loop"
    process = subprocess.Popen(
        [sys.executable, "-m", "asbuilt", "run", *map(str, QUICK), "--on", f"files:{box}",
         "--program", "csv", "-o", str(folder), "--json"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    sent = box / "outbox" / "motion_1.csv"
    deadline = time.monotonic() + 600.0
    while not sent.exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 1
    assert lines(out)[-1]["ending"] == "interrupted"
    assert any((box / "outbox" / "motion_1_csv").iterdir())
    model = asbuilt.load_robot("two-link")
    robot = DRIVERS.find("virtual")(DriverRequest(model=model, argument="lab"))
    answer_by_hand(box, "motion_1", robot.record(asbuilt.read_motion(sent, model)))
    answer_by_hand(box, "motion_2", robot.record(asbuilt.random_fourier(model, 5)))
    status, out, err = call(capsys, "run", "two-link", "--resume", folder)
    assert status == 1
    assert "motion_2.csv is not a log of the motion that was sent" in err
    assert "    1        6" in out
    assert [path.name for path in sorted((box / "outbox").glob("*.csv"))] == [
        "motion_1.csv",
        "motion_2.csv",
    ]


def test_wrong_log_stops_the_loop_with_its_cure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Degrees:
        moves_metal = False

        def __init__(self, request: DriverRequest) -> None:
            self.names = request.model.joint_names

        def record(self, motion: Motion) -> Recording:
            t = motion.sample_times(200.0)
            q = np.rad2deg(motion.derivative(t))
            return Recording(t=t, q=q, tau=np.ones_like(q), joint_names=self.names)

        def describe(self) -> str:
            return "a robot in degrees"

    known = {**DRIVERS, "degrees": Degrees}
    monkeypatch.setattr(DRIVERS, "_objects", known)
    folder = tmp_path / "loop"
    status, _, err = call(capsys, "run", *QUICK, "--on", "degrees", "-o", folder)
    assert status == 1
    assert "deg" in err
    assert [path.name for path in folder.glob("*motion.csv")] == ["round_1_motion.csv"]


def test_metal_moves_only_when_confirmed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Metal:
        def __init__(self, request: DriverRequest) -> None:
            pass

        def record(self, motion: Motion) -> Recording:
            raise AssertionError("it moved")

        def describe(self) -> str:
            return "a real robot"

    monkeypatch.setattr(DRIVERS, "_objects", {**DRIVERS, "metal": Metal})
    status, _, err = call(capsys, "run", *QUICK, "--on", "metal", "-o", tmp_path / "loop")
    assert status == 2
    assert "--yes" in err
    assert (tmp_path / "loop" / "round_1_motion.csv").is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "needs --on DRIVER"),
        (("--on", "virtaul"), "did you mean 'virtual'"),
        (("--on", "virtual:nothing"), "there are ideal, lab"),
        (("--on", "files"), "files:DIR"),
        (("--on", "virtual", "--until", "0"), "--until is 0"),
        (("--on", "virtual", "--for", "fun"), "torque, simulator, payload"),
        (("--on", "files:box", "--program", "nothing"), "unknown program"),
        (("--on", "virtual", "--program", "csv"), "runs no controller program"),
    ],
)
def test_wrong_usage_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...], said: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    status, _, err = call(capsys, "run", "two-link", *arguments)
    assert status == 2
    assert said in err


def test_folder_of_a_loop_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.json").write_text("{}")
    status, _, err = call(capsys, "run", "two-link", "--on", "virtual", "-o", tmp_path)
    assert status == 2
    assert "--resume" in err
    status, _, err = call(capsys, "run", "two-link", "--resume", tmp_path / "none")
    assert status == 2
    assert "holds no loop to resume" in err


def test_a_motion_never_takes_the_number_of_another(tmp_path: Path) -> None:
    robot = load_robot("two-link")
    driver = open_driver("files", DriverRequest(model=robot, argument=str(tmp_path)))
    first, second, third = (random_fourier(robot, seed, duration=4.0) for seed in range(3))
    for motion in (first, second):
        driver.waits_for(motion)  # type: ignore[attr-defined]
    (tmp_path / "outbox" / "motion_1.csv").unlink()
    assert "motion_2.csv" in driver.waits_for(second)  # type: ignore[attr-defined]
    assert "motion_3.csv" in driver.waits_for(third)  # type: ignore[attr-defined]


def test_a_resumed_loop_goes_on_as_it_was_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = RunOptions(rounds=2, seconds=4.0)
    settings = RunSettings(robot="two-link", on="virtual", options=options)
    RunFolder(tmp_path).keep_settings(settings)
    for given, said in (
        (("--seconds", "30"), "--seconds is another one"),
        (("--for", "payload"), "--for is another one"),
        (("--motion", tmp_path / "motion.csv"), "--motion is another one"),
    ):
        status, _, err = call(capsys, "run", "two-link", "--resume", tmp_path, *given)
        assert status == 2
        assert said in err
    assert RunFolder(tmp_path).read_settings() == settings


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{}", "holds a loop of '', not of two-link"),
        ('{"robot": "two-link"', "holds no settings of a loop"),
        ('{"robot": "two-link", "on": "virtual", "motion": null, "programs": [],'
         ' "options": {"until": "soon"}}', "options.until: TypeError expected a number"),
    ],
)  # fmt: skip
def test_damaged_settings_are_one_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, said: str
) -> None:
    (tmp_path / "run.json").write_text(content)
    status, _, err = call(capsys, "run", "two-link", "--resume", tmp_path)
    assert status in {1, 2}
    assert said in err
    assert "unexpected" not in err
