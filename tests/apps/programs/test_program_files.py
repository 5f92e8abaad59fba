"""Programs written from the command line."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import read_sheet
from asbuilt.writers import write_motion
from command_line import call


def motion_file(robot: str, folder: Path, duration: float = 4.0) -> Path:
    model = bundled_robot(robot)
    return write_motion(
        folder / "move 1.csv",
        random_fourier(model, rng=1, duration=duration),
        model.joint_names,
        rate=500.0,
    )


@pytest.mark.parametrize(
    ("robot", "form", "roles"),
    [
        ("kuka-iiwa7-r800", "sunrise", ["program", "sheet"]),
        ("kuka-iiwa7-r800", "fri", ["program", "motion", "application", "sheet"]),
        ("franka-panda", "franka", ["program", "motion", "sheet"]),
        ("ur10e", "urscript", ["program", "dry_run", "recipe", "sheet"]),
        ("scara", "ros2", ["program", "motion", "dry_run", "sheet"]),
        ("scara", "csv", ["program", "dry_run", "notes", "sheet"]),
    ],
)
def test_program_writes_every_file_it_names(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, robot: str, form: str, roles: list[str]
) -> None:
    arguments = [
        "program",
        robot,
        motion_file(robot, tmp_path),
        "--format",
        form,
        "--out",
        tmp_path / "out",
    ]
    status, out, err = call(capsys, *arguments, "--json")
    assert status == 0, err
    document: dict[str, Any] = json.loads(out)
    assert list(document["files"]) == roles
    assert sorted(Path(path) for path in document["files"].values()) == sorted(
        (tmp_path / "out").iterdir()
    )
    assert (document["robot"], document["format"], document["motion"]) == (robot, form, "move 1")
    assert document["dry_run_duration"] == pytest.approx(40.0)
    read_sheet(document["files"]["sheet"])
    if form == "ros2":
        assert os.access(document["files"]["program"], os.X_OK)
    status, out, _ = call(capsys, *arguments, "--name", "other")
    assert status == 0
    assert "NOT CHECKED: collisions" in out
    assert "other" in out


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["--format", "krl"], 2, "available: franka, sunrise, fri"),
        (["--format", "urscript"], 1, "6 revolute joints"),
        (["--format", "csv", "--rate", "0"], 2, "rate"),
        ([], 2, "--format"),
    ],
)
def test_wrong_calls_write_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], status: int, said: str
) -> None:
    got, _, err = call(
        capsys,
        "program",
        "scara",
        motion_file("scara", tmp_path),
        "--out",
        tmp_path / "out",
        *arguments,
    )
    assert got == status
    assert said in err
    assert "Traceback" not in err
    assert not (tmp_path / "out").exists()


def test_excite_refuses_an_unfit_format_before_it_designs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    status, _, err = call(
        capsys, "excite", "ur10e", "--program", "sunrise", "--out", tmp_path / "m.csv"
    )
    assert status == 1
    assert "7 revolute joints" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.study
def test_excite_writes_programs_beside_the_motion(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    options = [
        "--duration",
        "3",
        "--harmonics",
        "2",
        "--starts",
        "1",
        "--drive",
        "none",
    ]
    status, out, err = call(
        capsys,
        "excite",
        "two-link",
        *options,
        "--program",
        "ros2",
        "--program",
        "csv",
        "--out",
        tmp_path / "m.csv",
        "--json",
    )
    assert status == 0, err
    files = json.loads(out)["files"]
    assert {"motion", "ros2_program", "ros2_sheet", "csv_program", "csv_dry_run"} <= set(files)
    assert Path(files["ros2_program"]) == tmp_path / "m_ros2" / "m_run.py"
    assert all(Path(path).is_file() for path in files.values())
