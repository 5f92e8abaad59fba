"""The registry of estimators, and one that another distribution adds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

MODULE = """
from dataclasses import replace

from asbuilt.identification.estimators.least_squares import fit_least_squares
from asbuilt.identification.estimators.methods import estimator


@estimator("halved", "half of least squares", "half of every ordinary estimate", held_fixed=())
def estimate_half(data):
    found = fit_least_squares(data.information, prior=data.prior)
    return replace(found, method="halved", beta=0.5 * found.beta)
"""


def run(*arguments: object, path: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([path, *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def distribution(tmp_path: Path) -> str:
    """A folder of site-packages with a distribution that adds the estimator `halved`."""
    (tmp_path / "halved.py").write_text(MODULE)
    about = tmp_path / "halved-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: halved\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[asbuilt.estimators]\nhalved = halved\n")
    return str(tmp_path)


def test_an_estimator_of_another_distribution_runs_from_the_command_line(distribution, tmp_path):
    log = tmp_path / "log.csv"
    identify = ("-m", "asbuilt.cli.app", "identify", "scara", log, "--json", "--method")
    made = run(
        *("-m", "asbuilt.cli.app", "simulate", "scara", "--rate", "200", "--duration", "12"),
        *("--seed", "3", "--engine", "inverse-dynamics", "--out", log),
    )
    assert made.returncode == 0, made.stderr
    half, whole = (run(*identify, name, path=distribution) for name in ("halved", "ols"))
    assert half.returncode == 0, half.stderr
    halved, full = json.loads(half.stdout), json.loads(whole.stdout)
    assert halved["method"] == "halved"
    assert [2 * each["estimate"] for each in halved["parameters"]] == pytest.approx(
        [each["estimate"] for each in full["parameters"]]
    )
    unknown = run(*identify, "halved")
    assert unknown.returncode == 2
    assert "unknown estimator 'halved'" in unknown.stdout + unknown.stderr


def test_help_imports_no_estimator():
    code = (
        "import sys\n"
        "from asbuilt.cli.app import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "loaded = [name for name in sys.modules if '.identification.estimators.' in name]\n"
        "sys.exit(str(loaded) if loaded else 0)\n"
    )
    found = run("-c", code)
    assert found.returncode == 0, found.stderr
