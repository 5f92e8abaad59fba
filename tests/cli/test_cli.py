"""The command line as a user and as a script meet it."""

from __future__ import annotations

import html
import io
import json
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import asbuilt
from asbuilt.cli import main
from command_line import call, document, documented_fields

ROBOTS = ("scara", "two-link")


def refuse_constant(name: str) -> float:
    raise AssertionError(f"{name} is not JSON")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A training and a test recording of each robot, as it stands on the floor, and one noise-free
    by design.
    """
    folder = tmp_path_factory.mktemp("recorded")
    logs = {}
    for robot in ROBOTS:
        for kind, options in (("train", ["--preset", "lab"]), ("ideal", [])):
            log = folder / f"{robot}_{kind}.csv"
            with pytest.raises(SystemExit):
                main(
                    [
                        "simulate",
                        robot,
                        "--rate",
                        "200",
                        "--duration",
                        "12",
                        "--seed",
                        "3",
                        "--engine",
                        "inverse-dynamics",
                        "--out",
                        str(log),
                        *options,
                    ]
                )
            logs[f"{robot} {kind}"] = log
    return logs


@pytest.fixture(scope="module")
def studied(
    recorded: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], dict[str, Any]]:
    """What `identify --json --out` prints of the training recording of a robot, done once."""

    @cache
    def study(robot: str) -> dict[str, Any]:
        folder, printed = tmp_path_factory.mktemp("studied"), io.StringIO()
        options = ["--holdout", "blocks:1s:3", "--out", str(folder), "--json"]
        with redirect_stdout(printed), pytest.raises(SystemExit):
            main(["identify", robot, str(recorded[f"{robot} train"]), *options])
        return json.loads(printed.getvalue())

    return study


@pytest.mark.apps("fleet", "masses", "page", "paper", "programs", "watch")
def test_help_and_usage_errors(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(capsys, "--help")
    assert status == 0
    for command in (
        "robots",
        "show",
        "base",
        "check",
        "identify",
        "validate",
        "compare",
        "simulate",
        "reproduce",
        "demo",
    ):
        assert command in out
    assert call(capsys, "identify")[0] == 2
    assert call(capsys, "no-such-command")[0] == 2
    status, _, err = call(capsys, "base", "two-link", "--drive", "viscos")
    assert status == 2
    assert "viscous" in err


def test_robots_and_show(capsys: pytest.CaptureFixture[str]) -> None:
    names = [robot["name"] for robot in document(capsys, "robots")["robots"]]
    assert set(ROBOTS) <= set(names)
    for robot in names:
        shown = document(capsys, "show", robot)
        assert shown["robot"] == robot
        assert call(capsys, "show", robot)[1].startswith(robot)
    status, _, err = call(capsys, "show", "kuka-iiwa7")
    assert status in (1, 2)
    assert "kuka-iiwa7-r800" in err


@pytest.mark.parametrize(
    ("robot", "n_base"),
    [("kuka-iiwa7-r800", 43), ("ur10e", 36), ("puma-560", 36), ("franka-panda", 43)],
)
def test_base_counts(capsys: pytest.CaptureFixture[str], robot: str, n_base: int) -> None:
    found = document(capsys, "base", robot)
    assert found["n_base"] == n_base == len(found["parameters"])
    assert [entry["id"] for entry in found["standard"]] == list(range(1, found["n_standard"] + 1))
    assert {"id", "name", "expression", "symbolic", "value", "unit"} <= set(found["parameters"][0])
    assert {entry["status"] for entry in found["standard"]} <= {
        "unidentifiable",
        "grouped",
        "identifiable",
    }
    assert all(entry["why"] for entry in found["standard"])


@pytest.mark.parametrize("robot", ROBOTS)
def test_noise_free_recording_gives_back_the_description(
    capsys: pytest.CaptureFixture[str], recorded: dict[str, Path], robot: str
) -> None:
    by_design = {
        entry["id"]: entry["value"] for entry in document(capsys, "base", robot)["parameters"]
    }
    found = document(
        capsys,
        "identify",
        robot,
        recorded[f"{robot} ideal"],
        "--drive",
        "none",
        "--holdout",
        "last:0.3",
    )
    scale = max(abs(value) for value in by_design.values())
    for parameter in found["parameters"]:
        assert parameter["estimate"] == pytest.approx(by_design[parameter["id"]], abs=2e-3 * scale)
    assert found["validation"][0]["relative_error"] < 2e-3


@pytest.mark.parametrize("robot", ["scara"])
def test_identify_writes_everything_and_validates(
    capsys: pytest.CaptureFixture[str],
    recorded: dict[str, Path],
    studied: Callable[[str], dict[str, Any]],
    robot: str,
) -> None:
    log, found = recorded[f"{robot} train"], studied(robot)
    assert set(found) in documented_fields()["identify"]
    for kind in ("result", "report", "parameters", "summary", "torque"):
        assert Path(found["files"][kind]).stat().st_size > 0
    assert not [
        path
        for path in Path(found["files"]["result"]).parent.iterdir()
        if path.name.startswith(".") or path.suffix == ".tmp"
    ]
    for metrics in (found["train"], *found["validation"], found["cad"]):
        assert {"source", "rms", "max_abs", "r_squared", "relative_error"} <= set(metrics)
        assert len(metrics["rms"]) == len(found["joints"])
    assert np.mean(found["validation"][0]["rms"]) < np.mean(found["cad"]["rms"])
    validated = document(capsys, "validate", found["files"]["result"], log)
    assert validated["validation"][0]["relative_error"] < validated["cad"][0]["relative_error"]
    compared = document(capsys, "compare", found["files"]["result"])
    assert len(compared["parameters"]) == found["n_base"]
    assert len(compared["attribution"]["sentences"]) == len(found["joints"])
    assert compared["determination"]["sentences"] == found["determination"]["sentences"]
    status, out, _ = call(capsys, "compare", found["files"]["result"])
    assert status == 0
    assert "as built" in out
    assert "causes of the CAD error" in out
    same = document(capsys, "compare", found["files"]["result"], "--with", found["files"]["result"])
    assert same["n_changed"] == 0
    drifted = document(
        capsys,
        "compare",
        found["files"]["result"],
        "--with",
        found["files"]["result"],
        "--out",
        log.parent / "drifted",
    )
    assert {Path(path).name for path in drifted["files"].values()} == {
        "drift.csv",
        "drift.txt",
        "drift.html",
    }
    assert (
        call(
            capsys,
            "compare",
            found["files"]["result"],
            "--with",
            found["files"]["result"],
            "--cad",
            "scara",
        )[0]
        == 2
    )
    assert call(capsys, "compare", found["files"]["result"], "--cad-tolerance", "much")[0] == 2
    for options, idle in (
        (("--holdout", "last:0.3"), "--holdout"),
        (("--rate", 100, "--flip-torque"), "--rate, --flip-torque"),
        (("--with", found["files"]["result"], "--cad-tolerance", "5%"), "--cad-tolerance"),
    ):
        status, out, err = call(capsys, "compare", found["files"]["result"], *options)
        assert (status, out) == (2, "")
        assert f"leave out {idle}" in err
    written = document(
        capsys,
        "compare",
        found["files"]["result"],
        "--cad-tolerance",
        "5%",
        "--out",
        log.parent / "compared",
    )
    assert written["chi_square_tolerance"]["statistic"] < written["chi_square"]["statistic"]
    assert all(Path(path).stat().st_size > 0 for path in written["files"].values())


@pytest.mark.parametrize("kind", ["bootstrap"])
@pytest.mark.study
def test_every_output_says_how_errors_were_judged(
    capsys: pytest.CaptureFixture[str], recorded: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    found = document(
        capsys, "identify", "scara", recorded["scara train"], "--errors", kind, "--out", tmp_path
    )
    assert (found["errors"]["kind"], found["errors"]["asked"]) == (kind, kind)
    stored = json.loads(Path(found["files"]["result"]).read_text())["errors"]
    assert stored == {name: value for name, value in found["errors"].items() if name != "sentence"}
    sentence = found["errors"]["sentence"]
    assert sentence.startswith(f"Standard errors ({kind}): ")
    assert sentence in " ".join(Path(found["files"]["summary"]).read_text().split())
    page = Path(found["files"]["report"]).read_text()
    assert f"<dt>standard errors</dt><dd>{kind}</dd>" in page
    assert sentence in html.unescape(page)
    assert all(
        note in html.unescape(page)
        for note in json.loads(Path(found["files"]["result"]).read_text())["notes"]
    )
    compared = call(capsys, "compare", found["files"]["result"], "--full")[1]
    assert sentence in " ".join(compared.split())
    if kind == "bootstrap":
        assert f"the choice of {found['method']}" in sentence


@pytest.mark.study
def test_json_is_strict_and_alone_on_stdout(recorded: dict[str, Path]) -> None:
    command = [
        sys.executable,
        "-m",
        "asbuilt",
        "identify",
        "scara",
        str(recorded["scara train"]),
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout, parse_constant=refuse_constant)
    assert [each["source"].partition(", ")[2] for each in found["validation"]] == [
        f"held out {found['holdout']}"
    ]
    assert "final_fit" in {warning["code"] for warning in found["warnings"]}


def test_flipped_torque_is_refused_with_its_cure(
    capsys: pytest.CaptureFixture[str], recorded: dict[str, Path], tmp_path: Path
) -> None:
    lines = recorded["scara ideal"].read_text().splitlines()
    header = lines[0].split(",")
    flip = [k for k, name in enumerate(header) if name.startswith("tau")]
    rows = np.loadtxt(lines[1:], delimiter=",")
    rows[:, flip] *= -1
    log = tmp_path / "flipped.csv"
    np.savetxt(log, rows, delimiter=",", header=lines[0], comments="")
    status, out, err = call(capsys, "identify", "scara", log, "--out", tmp_path / "out")
    assert (status, out) == (1, "")
    assert "--flip-torque" in err
    assert not (tmp_path / "out").exists()
    assert call(capsys, "identify", "scara", log, "--flip-torque")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["show", "missing.urdf"], 1, "missing.urdf"),
        (["check", "scara", "missing.csv"], 1, "missing.csv"),
        (["identify", "scara", "{log}", "--holdout", "sometimes"], 2, "blocks:5s:3"),
        (["identify", "scara", "{log}", "--method", "magic"], 2, "wls"),
        (["identify", "scara", "{log}", "--gain", "a,b"], 2, "--gain"),
        (["identify", "scara", "{log}", "--gain", "1,,2,3"], 2, "--gain"),
        (["identify", "scara", "{log}", "--gain", "1,nan,2,3"], 2, "--gain"),
        (["identify", "scara", "{log}", "--gain", "1,2"], 1, "4"),
        (["check", "scara", "{log}", "--torque-source", ""], 2, "sensor"),
        (
            ["gains", "scara", "{log}", "--loaded", "{other}", "--mass", "1", "--com", "0,1"],
            2,
            "--com takes 3 numbers",
        ),
        (["gains", "scara", "{log}", "--loaded", "{log}", "--mass", "1"], 2, "is given twice"),
        (["identify", "scara", "{log}", "--out", "{log}/x"], 2, "is a file"),
        (["identify", "scara", "{log}", "--cutoff", "1e-9"], 2, "raise the cutoff"),
        (["simulate", "scara", "--seed", "-1"], 2, "--seed"),
        (["simulate", "scara", "--free", "drop", "--robot-seed", "1"], 2, "--robot-seed"),
        (["compare", "before.json", "after.json"], 2, "compare RESULT --with RESULT2"),
        (
            ["simulate", "scara", "--rate", "0", "--engine", "inverse-dynamics"],
            2,
            "greater than or equal to 0.1",
        ),
        (["excite", "scara", "--rate", "nan"], 2, "less than or equal to 100000"),
        (["excite", "scara", "--out", "{log}/motion.csv"], 2, "is a file"),
        (["show", ""], 1, "no bundled robot"),
        (["show", "x" * 5000], 1, "File name too long"),
        (["identify", "scara", "{log}", "--cutoff", "-3"], 2, "cutoff"),
        (["identify", "scara", "{log}", "--torque-source", "guess"], 2, "sensor"),
        (["identify", "kuka-iiwa7-r800", "{log}"], 1, "4"),
        (["identify", "scara", "{log}", "--decimate", "0"], 2, "decimate"),
        (
            ["gains", "scara", "{log}", "--loaded", "{other}", "--mass", "1", "--cutoff", "auto"],
            2,
            "--cutoff",
        ),
        (["validate", "{log}", "{other}"], 1, "name the robot before it"),
        (["compare", "{log}"], 1, "result"),
        (
            ["identify", "scara", "{log}", "--cutoff", "auto", "--holdout", "sometimes"],
            2,
            "blocks:5s:3",
        ),
        (["validate", "scara", "{log}", "{log}"], 2, "is given twice"),
        (["check", "scara", "{log}", "{log}"], 2, "is given twice"),
        (["view", "scara", "--save", "{log}/robot.png"], 2, "is a file"),
    ],
)
def test_wrong_calls_name_the_place_and_the_cure(
    capsys: pytest.CaptureFixture[str],
    recorded: dict[str, Path],
    arguments: list[str],
    status: int,
    says: str,
) -> None:
    given = [
        argument.format(log=recorded["scara ideal"], other=recorded["scara train"])
        for argument in arguments
    ]
    found, out, err = call(capsys, *given)
    assert (found, out) == (status, "")
    assert says in err
    assert "Traceback" not in err
    assert "should not have happened" not in err


def test_what_is_missing_is_told_before_any_work(
    capsys: pytest.CaptureFixture[str], recorded: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asbuilt.identify", lambda *_, **__: pytest.fail("the study ran"))
    status, _, err = call(
        capsys, "identify", "scara", recorded["scara train"], "--payload", "missing.csv"
    )
    assert status == 1
    assert "missing.csv" in err


@pytest.mark.study
def test_payload_of_a_loaded_recording(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """The virtual robot carries 3 % of its moving mass; a bare one was recorded before."""
    from asbuilt.description import LinkInertia, load_robot
    from asbuilt.excitation import random_fourier
    from asbuilt.experiment import VirtualRobot
    from asbuilt.writers import write_recording

    robot = VirtualRobot.ideal(load_robot("kuka-iiwa7-r800"))
    carrying = robot.with_tool(
        LinkInertia.from_com(2.0, [0.0, 0.02, 0.08], np.diag([0.01, 0.01, 0.005])), at="flange"
    )
    for name, machine, seed in (("bare", robot, 1), ("loaded", carrying, 2)):
        motion = random_fourier(robot.model, rng=seed, duration=12.0, n_harmonics=8)
        write_recording(tmp_path / f"{name}.csv", machine.record(motion, rate=200.0).recording)
    found = document(
        capsys,
        "identify",
        "kuka-iiwa7-r800",
        tmp_path / "bare.csv",
        "--payload",
        tmp_path / "loaded.csv",
        "--method",
        "wls",
        "--out",
        tmp_path,
    )
    assert found["payload"]["mass"]["estimate"] == pytest.approx(2.0, abs=0.02)
    assert found["payload"]["validation"][0]["source"].endswith("loaded.csv, the data used")
    assert "kuka-iiwa7-r800: payload at flange" in Path(found["files"]["summary"]).read_text()
    assert 'id="payload-values"' in Path(found["files"]["report"]).read_text()
    assert (
        json.loads(Path(found["files"]["payload"]).read_text())["mass"] == found["payload"]["mass"]
    )
    held = document(
        capsys,
        "identify",
        "kuka-iiwa7-r800",
        tmp_path / "bare.csv",
        "--payload",
        tmp_path / "loaded.csv",
        "--method",
        "wls",
        "--holdout",
        "last:0.3",
    )
    assert held["payload"]["validation"][0]["source"].endswith("loaded.csv, held out last:0.3")
    assert held["payload"]["n_samples"] < 0.8 * found["payload"]["n_samples"]
    alone = document(
        capsys, "payload", found["files"]["result"], tmp_path / "loaded.csv", "--out", tmp_path
    )
    assert alone["frame"] == "flange"
    assert alone["com"]["estimate"] == pytest.approx([0.0, 0.02, 0.08], abs=0.005)
    assert alone["physically_consistent"] is True
    assert alone["validation"][0]["relative_error"] < 0.2 * alone["bare"][0]["relative_error"]
    assert Path(alone["files"]["payload"]).stat().st_size > 0
    status, out, _ = call(capsys, "payload", found["files"]["result"], tmp_path / "loaded.csv")
    assert status == 0
    assert "of gains" not in out
    by_current = (
        "payload",
        found["files"]["result"],
        tmp_path / "loaded.csv",
        "--torque-source",
        "current",
    )
    doubted, tighter = (
        document(capsys, *by_current),
        document(capsys, *by_current, "--gain-uncertainty", "2%"),
    )
    assert alone["gain_uncertainty"] == [0.0] * 7
    assert doubted["gain_uncertainty"] == [0.07] * 7
    mass = doubted["mass"]
    assert mass["std_error"] == pytest.approx(
        np.hypot(mass["std_error_noise"], mass["std_error_gains"])
    )
    assert mass["std_error_noise"] == pytest.approx(alone["mass"]["std_error"], rel=1e-3)
    assert sum(mass["slope_by_joint"]) == pytest.approx(2.0, abs=0.05)
    assert tighter["mass"]["std_error_gains"] == pytest.approx(
        2 / 7 * mass["std_error_gains"], rel=0.01
    )
    assert "they leave" in " ".join(call(capsys, *by_current)[1].split())
    assert call(capsys, *by_current, "--gain-uncertainty", "much")[0] == 2
    assert call(capsys, *by_current, "--gain-uncertainty", "90%")[0] == 2


@pytest.mark.study
def test_simulate_on_the_engine_with_a_tool_and_let_go(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log = tmp_path / "lab.csv"
    told = document(
        capsys,
        "simulate",
        "ur10e",
        "--preset",
        "lab",
        "--tool",
        "2@0,0,0.05",
        "--at",
        "flange",
        "--duration",
        "2",
        "--rate",
        "250",
        "--out",
        log,
    )
    assert told["n_samples"] == 501
    truth = json.loads(Path(told["files"]["truth"]).read_text())
    assert truth["settings"]["preset"] == "lab"
    assert truth["parameters"]["m6"] > 2.0
    for release in ("drop", "free", "step"):
        freed = document(
            capsys,
            "simulate",
            "two-link",
            "--free",
            release,
            "--duration",
            "0.5",
            "--out",
            tmp_path / f"{release}.csv",
        )
        assert freed["energy"]["imbalance"] < 1e-6
        assert Path(freed["files"]["figure"]).read_bytes()[:4] == b"\x89PNG"
    for wrong, message in (
        (("--preset", "shop"), "is not one of ideal, lab, factory"),
        (("--engine", "bullet"), "is not one of mujoco, inverse-dynamics"),
        (
            ("--engine", "inverse-dynamics", "--preset", "factory"),
            "no virtual robot 'factory' on the engine",
        ),
        (("--tool", "heavy"), "a tool is KG@X,Y,Z"),
        (("--tool", "1", "--at", "nose"), "no moving link or frame 'nose'"),
        (("--free", "hop"), "is not one of drop, step, free"),
        (("--free", "drop", "--start", "1"), "start must be 2 finite numbers"),
    ):
        status, _, err = call(capsys, "simulate", "two-link", *wrong)
        assert status == 2
        assert message in err


@pytest.mark.study
def test_view_saves_pages_and_pictures_and_results_run_forward(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    recorded: dict[str, Path],
    studied: Callable[[str], dict[str, Any]],
) -> None:
    log, result = recorded["scara train"], studied("scara")["files"]["result"]
    freed = document(
        capsys,
        "simulate",
        result,
        "--free",
        "free",
        "--duration",
        "0.5",
        "--out",
        tmp_path / "free.csv",
    )
    assert freed["energy"]["imbalance"] < 1e-6
    saved = document(capsys, "view", result, log, "--save", tmp_path / "motion.html")
    assert saved["duration"] == pytest.approx(12.0, abs=0.01)
    assert "__VISER_EMBED_DATA__" in Path(saved["files"]["page"]).read_text(encoding="utf-8")
    assert call(capsys, "view", "scara", "--save", tmp_path / "told.png")[1].startswith(
        "written:\n  picture"
    )
    still = document(capsys, "view", "scara", "--save", tmp_path / "still.png")
    assert Path(still["files"]["picture"]).read_bytes()[:4] == b"\x89PNG"
    for wrong, status, message in (
        (("ur10e", "--save", tmp_path / "a.gif"), 2, "there is no motion"),
        (("ur10e", "--save", tmp_path / "a.bmp"), 2, "a picture is written as"),
        (("ur10e", tmp_path / "none.csv"), 1, "cannot be read"),
        (("ur10e", "--port", "0"), 2, "a port is a number"),
    ):
        code, _, err = call(capsys, "view", *wrong)
        assert code == status
        assert message in err


@pytest.mark.study
def test_a_robot_too_heavy_for_its_stated_torque_is_checked(tmp_path, capsys) -> None:
    folder = Path(asbuilt.__file__).parent / "description" / "robots"
    text = (folder / "kuka-iiwa7-r800.toml").read_text(encoding="utf-8")
    robot = tmp_path / "weak.toml"
    robot.write_text(re.sub(r"torque = [0-9.]+", "torque = 0.2", text), encoding="utf-8")
    # It stands upright, where it weighs nothing, and turns about the vertical: its torques are
    # within these limits, and those of nearly all other postures are not.
    t = np.arange(0.0, 10.0, 0.005)
    phases = np.outer(t, [1.0, 1.3]) + np.array([0.0, 1.0])
    q, qd = np.zeros((2, t.size, 7))
    q[:, [0, 6]] = 0.3 * np.sin(phases)
    qd[:, [0, 6]] = 0.3 * np.cos(phases)
    tau = 0.1 * np.sign(qd) + 0.01 * np.random.default_rng(0).normal(size=qd.shape)
    names = [f"{kind}{k}" for kind in ("q", "tau") for k in range(1, 8)]
    log = tmp_path / "log.csv"
    table = np.column_stack([t, q, tau])
    np.savetxt(log, table, delimiter=",", header=",".join(["t", *names]), comments="")
    status, out, err = call(capsys, "check", robot, log, "--json")
    assert status == 0, err
    (found,) = json.loads(out)["recordings"]
    assert found["findings"]
    assert found["information"] is None
