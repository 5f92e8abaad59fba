"""The shell completes commands, robots, methods, choices and files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from asbuilt.description import robot_names
from asbuilt.identification import methods


def completed(line: str, folder: Path) -> list[str]:
    words = line.split()
    asked = {
        "_ASBUILT_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - (not line.endswith(" "))),
    }
    command = [sys.executable, "-m", "asbuilt"]
    run = subprocess.run(
        command, env=os.environ | asked, cwd=folder, capture_output=True, text=True, check=True
    )
    return run.stdout.split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("asbuilt show my", ["my_arm.urdf"]),
        ("asbuilt identify scara log.csv --method ", list(methods)),
        *(
            pytest.param(line, expected, marks=pytest.mark.study)
            for line, expected in (
                ("asbuilt ide", ["identify"]),
                ("asbuilt identify ", list(robot_names())),
                ("asbuilt identify kuka", [n for n in robot_names() if n.startswith("kuka")]),
                ("asbuilt identify scara log.csv --mounting e", ["estimate"]),
            )
        ),
    ],
)
def test_completion(tmp_path: Path, line: str, expected: list[str]) -> None:
    (tmp_path / "my_arm.urdf").touch()
    # A registry that this process filled in another order has the same names.
    assert sorted(completed(line, tmp_path)) == sorted(expected)
